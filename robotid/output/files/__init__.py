"""Files for other programs: the URDF with its sidecar, result.json, and models of simulators."""

__all__: list[str] = []
