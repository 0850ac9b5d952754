"""The physically consistent fit: cone, prior, convex programme, log-Cholesky coordinates."""

__all__: list[str] = []
