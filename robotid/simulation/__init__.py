"""Plants, controllers, motions, and the logs that they give."""

__all__: list[str] = []
