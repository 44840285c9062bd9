"""Public names, imported on first use so that `import dln_jax` stays fast."""

from dln_jax.data.log import read_log
from dln_jax.data.robots import read_robot
from dln_jax.data.schema import load as load_trajectories
from dln_jax.data.schema import save as save_trajectories
from dln_jax.export.c.load import load_c
from dln_jax.export.c.source import export_c
from dln_jax.export.low_latency import enable_low_latency, low_latency
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import Adam, GaussNewton
from dln_jax.learning.engine.problem import Problem
from dln_jax.mechanics.dynamics import InverseForward, PhaseRates
from dln_jax.mechanics.equations import dynamics, flow
from dln_jax.mechanics.friction import joint_dissipation
from dln_jax.mechanics.hamiltonian import HamiltonianSystem
from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.mechanics.natural import NaturalHamiltonian, NaturalSystem
from dln_jax.mechanics.trees.recursions import tree_system
from dln_jax.models.model import Model, make_delan
from dln_jax.runs.training import evaluate, identify, train
from dln_jax.types import InputError, Needs
from dln_jax.zoo.descriptions import build, describe, make, model_names
from dln_jax.zoo.run import load
from dln_jax.zoo.run import save_model as save

__all__ = [
    "Adam",
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
    "Problem",
    "build",
    "describe",
    "dynamics",
    "enable_low_latency",
    "evaluate",
    "export_c",
    "fit",
    "flow",
    "identify",
    "joint_dissipation",
    "load",
    "load_c",
    "load_trajectories",
    "low_latency",
    "make",
    "make_delan",
    "model_names",
    "read_log",
    "read_robot",
    "save",
    "save_trajectories",
    "train",
    "tree_system",
]
