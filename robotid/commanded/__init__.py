"""What drives and bodies are, from commands and positions: closed loops rolled out and fitted."""

__all__: list[str] = []
