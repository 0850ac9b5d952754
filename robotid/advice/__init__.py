"""Next steps after a result, with the command or the setting to type."""

__all__: list[str] = []
