"""Estimators that read one sample after the other."""

__all__: list[str] = []
