"""Recordings: files, logs, and the smooth trajectories computed from them."""

__all__: list[str] = []
