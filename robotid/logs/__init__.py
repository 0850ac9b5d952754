"""What was recorded: files, logs and the smooth trajectories that come of them."""

__all__: list[str] = []
