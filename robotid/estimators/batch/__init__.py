"""Estimators that read the factors: least squares, plain, weighted and total."""

__all__: list[str] = []
