"""One module per command: files in, files out."""

__all__: list[str] = []
