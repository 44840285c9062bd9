"""Metrics, latency, reports and figures."""
