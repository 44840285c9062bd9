"""What the reports measure."""

__all__ = []
