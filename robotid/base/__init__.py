"""Errors, findings, settings, text and files; nothing of robots."""
