"""The logs of an identification: read whole or in pieces, and reduced to factors."""

__all__: list[str] = []
