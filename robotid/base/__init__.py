"""Errors, findings, settings, text and files; nothing of robots."""

__all__: list[str] = []
