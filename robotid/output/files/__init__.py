"""Files for other programs: the URDF with its sidecar, result.json, and models of simulators."""
