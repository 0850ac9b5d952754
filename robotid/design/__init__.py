"""Excitation trajectories: motions within a robot's limits that determine its parameters best."""
