"""Dynamics that come from energies: write or learn a scalar, get equations of motion, rollouts and controllers."""

import dln_jax.interrupts  # noqa: F401  first, as the others take a second to import
from dln_jax.data.schema import Trajectories
from dln_jax.data.schema import load as load_trajectories
from dln_jax.data.schema import save as save_trajectories
from dln_jax.deploy.c.load import load_c
from dln_jax.deploy.c.source import export_c
from dln_jax.deploy.low_latency import enable_low_latency, low_latency
from dln_jax.mechanics import lagrangian, natural
from dln_jax.mechanics.dynamics import Decomposition, Dynamics
from dln_jax.mechanics.natural import NaturalSystem
from dln_jax.models.delan import make_delan
from dln_jax.models.model import Model
from dln_jax.types import InputError, Needs
from dln_jax.zoo.descriptions import describe
from dln_jax.zoo.run import Run, load, save

__all__ = [
    "Decomposition",
    "Dynamics",
    "InputError",
    "Model",
    "NaturalSystem",
    "Needs",
    "Run",
    "Trajectories",
    "describe",
    "enable_low_latency",
    "export_c",
    "lagrangian",
    "load",
    "load_c",
    "load_trajectories",
    "low_latency",
    "make_delan",
    "natural",
    "save",
    "save_trajectories",
]
