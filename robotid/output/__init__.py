"""What is written and shown: files, pages, reports, the viewer."""

__all__: list[str] = []
