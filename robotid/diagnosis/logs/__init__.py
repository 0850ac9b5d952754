"""Checks of logs and of URDF files for faults."""

__all__: list[str] = []
