"""Rivals: other programs and methods on the same tasks, one file each."""
