"""The names of `dln_jax`, which imports this module, and JAX with it, when the first of them is used."""

from dln_jax.data.robots import Robot, read_robot
from dln_jax.data.schema import Trajectories
from dln_jax.data.schema import load as load_trajectories
from dln_jax.data.schema import save as save_trajectories
from dln_jax.export.c.load import load_c
from dln_jax.export.c.source import export_c
from dln_jax.export.low_latency import enable_low_latency, low_latency
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import Adam, GaussNewton
from dln_jax.learning.engine.problem import Problem, Training
from dln_jax.mechanics.closed_form import ClosedForm, RecursiveSystem
from dln_jax.mechanics.dynamics import (
    Decomposition,
    Dynamics,
    Flow,
    InverseForward,
    PhaseRates,
    PlainDynamics,
    PlainFlow,
)
from dln_jax.mechanics.equations import dynamics, flow
from dln_jax.mechanics.friction.curves import joint_dissipation
from dln_jax.mechanics.hamiltonian import HamiltonianSystem
from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.mechanics.natural import NaturalHamiltonian, NaturalSystem
from dln_jax.mechanics.trees.description import Tree
from dln_jax.mechanics.trees.recursions import tree_system
from dln_jax.models.model import Model, make_delan
from dln_jax.types import InputError, Needs
from dln_jax.zoo.descriptions import build, describe
from dln_jax.zoo.run import Run, load
from dln_jax.zoo.run import save_model as save

__all__ = [
    "Adam",
    "ClosedForm",
    "Decomposition",
    "Dynamics",
    "Flow",
    "GaussNewton",
    "HamiltonianSystem",
    "InputError",
    "InverseForward",
    "LagrangianSystem",
    "Model",
    "NaturalHamiltonian",
    "NaturalSystem",
    "Needs",
    "PhaseRates",
    "PlainDynamics",
    "PlainFlow",
    "Problem",
    "RecursiveSystem",
    "Robot",
    "Run",
    "Training",
    "Trajectories",
    "Tree",
    "build",
    "describe",
    "dynamics",
    "enable_low_latency",
    "export_c",
    "fit",
    "flow",
    "joint_dissipation",
    "load",
    "load_c",
    "load_trajectories",
    "low_latency",
    "make_delan",
    "read_robot",
    "save",
    "save_trajectories",
    "tree_system",
]
