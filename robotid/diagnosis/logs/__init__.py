"""Checks of logs and of URDF files for faults."""
