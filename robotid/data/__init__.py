"""Recordings: files, logs, and the smooth trajectories computed from them."""
