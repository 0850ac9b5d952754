"""Recursive estimators: the samples are read one by one."""
