"""Measure numerical stability on hard cases."""
