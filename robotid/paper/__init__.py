"""The paper's procedure on its planar arm."""

__all__: list[str] = []
