"""Parallel processing of long logs: worker processes, Dask clusters, checkpoints of fleets."""

__all__: list[str] = []
