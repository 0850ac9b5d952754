"""Identification while the robot moves."""

__all__: list[str] = []
