"""Vectors and rigid-body kernels in compiled code."""
