"""What is concluded from a fit: findings, the check of the scale, and the verdict."""

__all__: list[str] = []
