"""The paper's procedure on its planar arm."""
