"""What the robot is: its URDF, parameters, drives, dynamics and geometry."""
