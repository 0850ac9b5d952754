"""What people read: the report and comparisons."""

__all__: list[str] = []
