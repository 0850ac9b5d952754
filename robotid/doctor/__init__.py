"""What is wrong with logs, or with a URDF."""

__all__: list[str] = []
