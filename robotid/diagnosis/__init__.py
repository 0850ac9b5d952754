"""What the residual of a fit says: terms that drives have, faults of recordings and of the URDF."""

__all__: list[str] = []
