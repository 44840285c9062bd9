"""Measurements behind the reports."""

__all__ = []
