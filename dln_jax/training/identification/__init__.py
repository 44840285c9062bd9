"""Identifies the parameters of a robot from logs."""
