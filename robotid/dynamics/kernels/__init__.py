"""Vectors and rigid-body kernels in compiled code."""

__all__: list[str] = []
