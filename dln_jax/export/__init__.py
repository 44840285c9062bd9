"""Exports of models: low-latency functions and C99 source."""

from dln_jax.export.c import Cost, export_c, export_run, functions_of_run, functions_of_system, load_c, stated_costs
from dln_jax.export.low_latency import enable_low_latency, low_latency

__all__ = [
    "Cost",
    "enable_low_latency",
    "export_c",
    "export_run",
    "functions_of_run",
    "functions_of_system",
    "load_c",
    "low_latency",
    "stated_costs",
]
