"""Motions and contact forces that constraints determine."""

__all__: list[str] = []
