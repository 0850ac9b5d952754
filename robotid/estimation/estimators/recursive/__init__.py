"""Recursive estimators: the samples are read one by one."""

__all__: list[str] = []
