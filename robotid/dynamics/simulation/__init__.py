"""Simulation: plants, controllers, motions, sensors and closed loops."""
