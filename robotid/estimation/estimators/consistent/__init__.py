"""The physically consistent fit: cone, prior, convex programme, log-Cholesky coordinates."""
