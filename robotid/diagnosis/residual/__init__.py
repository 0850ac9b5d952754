"""Analysis of the residual of a fit: missing drive terms, faults of recordings and of the URDF."""
