"""Excitation trajectories: motions within a robot's limits that determine its parameters best."""

__all__: list[str] = []
