"""Trains differential networks on functions."""
