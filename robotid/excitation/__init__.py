"""Which motion to record: the one that tells the most within a robot's limits."""

__all__: list[str] = []
