"""Differential networks on the published functions."""
