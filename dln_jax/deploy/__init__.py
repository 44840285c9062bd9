"""Trained models as jitted functions."""
