"""Audit of a URDF: what is missing, impossible or implausible in it."""
