"""Who works on the pieces of a long log: this process, others, or a Dask cluster; checkpoints."""

__all__: list[str] = []
