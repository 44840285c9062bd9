"""Shared parts of the commands: typed arguments, one-line errors, progress and tables."""
