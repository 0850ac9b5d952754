"""Motions and contact forces that constraints determine."""
