"""The physically consistent fit: constraints of bodies, interior-point method, estimator."""
