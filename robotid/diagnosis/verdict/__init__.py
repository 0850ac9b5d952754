"""Conclusions from a fit: findings, the scale check and the verdict."""
