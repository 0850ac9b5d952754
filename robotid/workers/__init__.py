"""Parallel processing of long logs: worker processes, Dask clusters and checkpoints."""

__all__: list[str] = []
