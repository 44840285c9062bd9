"""Exports of models: low-latency functions, StableHLO artefacts and C99 source."""

from dln_jax.export.c import Cost, export_c, export_run, functions_of_run, functions_of_system, load_c, stated_costs
from dln_jax.export.low_latency import enable_low_latency, low_latency
from dln_jax.export.stablehlo import export_dynamics, export_stablehlo, load_stablehlo

__all__ = [
    "Cost",
    "enable_low_latency",
    "export_c",
    "export_dynamics",
    "export_run",
    "export_stablehlo",
    "functions_of_run",
    "functions_of_system",
    "load_c",
    "load_stablehlo",
    "low_latency",
    "stated_costs",
]
