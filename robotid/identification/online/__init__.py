"""Online identification."""

__all__: list[str] = []
