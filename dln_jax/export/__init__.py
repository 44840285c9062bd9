"""Exports of models: low-latency functions and C99 source."""
