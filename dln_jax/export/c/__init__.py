"""C99 source of JAX functions."""

from dln_jax.export.c.families import functions_of_run, functions_of_system
from dln_jax.export.c.interface import Cost, stated_costs
from dln_jax.export.c.load import load_c
from dln_jax.export.c.run import export_run
from dln_jax.export.c.source import export_c

__all__ = [
    "Cost",
    "export_c",
    "export_run",
    "functions_of_run",
    "functions_of_system",
    "load_c",
    "stated_costs",
]
