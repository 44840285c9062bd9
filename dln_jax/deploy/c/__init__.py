"""C99 source of trained models."""

from dln_jax.deploy.c.load import CDynamics, CFunction, CPlainDynamics, load_c
from dln_jax.deploy.c.source import export_c, export_run

__all__ = [
    "CDynamics",
    "CFunction",
    "CPlainDynamics",
    "export_c",
    "export_run",
    "load_c",
]
