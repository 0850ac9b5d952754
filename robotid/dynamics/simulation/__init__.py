"""Simulation: plants, controllers, motions, sensors and closed loops."""

__all__: list[str] = []
