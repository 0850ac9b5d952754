"""Parallel processing of long logs: worker processes, Dask clusters, checkpoints of fleets."""
