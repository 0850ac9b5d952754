"""What programs read: the URDF with its sidecar, and result.json."""

__all__: list[str] = []
