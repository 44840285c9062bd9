"""Metrics of a model: errors, rollouts, definiteness, latency, coverage."""
