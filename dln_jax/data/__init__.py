"""Data: the file schema, readers and splits."""

from dln_jax.data import functions
from dln_jax.data.functions import FunctionSamples, SampleSplit
from dln_jax.data.robots import Robot, read_robot
from dln_jax.data.schema import Trajectories, load, save
from dln_jax.data.splits import Split, hold_out, merged, select, split

__all__ = [
    "FunctionSamples",
    "Robot",
    "SampleSplit",
    "Split",
    "Trajectories",
    "functions",
    "hold_out",
    "load",
    "merged",
    "read_robot",
    "save",
    "select",
    "split",
]
