"""What the robot is: its URDF, parameters, drives, dynamics and geometry."""

__all__: list[str] = []
