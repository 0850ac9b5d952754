"""Logs of constrained robots: contacts, closed chains, the motion of a floating base."""

__all__: list[str] = []
