"""What the commands share: typed arguments, errors as one line, progress and tables."""

__all__ = []
