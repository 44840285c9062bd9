"""Network sizes and training lengths of the models for every Hamiltonian task."""

from typing import NamedTuple

from dln_jax.learning.shooting import Weights
from dln_jax.training.hamiltonian.tasks import MEASURED, REAL, WINDOW


class Recipe(NamedTuple):
    """Networks of a task and their training; chosen by trial on seed 0, and the same for all seeds."""

    suits: str
    """The model that suits the scene."""
    width: int
    """Hidden units per layer of that model."""
    depth: int
    network: int
    """Hidden units per layer of less structured models: a Hamiltonian that is one network, and the baseline."""
    network_depth: int
    steps: int
    """Iterations of Gauss-Newton on rates."""
    samples: int
    seconds: float
    """Time limit for both fits together, compilation included; only `hnn_table` applies it."""
    trajectory_steps: int = 0
    """Iterations of Gauss-Newton on trajectories after the fit of rates."""
    window: int = 0
    """Samples per window."""
    weights: Weights | None = None
    """Weights of the trajectories; `None` for the standard deviations of the data."""
    substeps: int = 4


# The noise of spring and pendulum has sd 0.1; their rates are noiseless and get a weight of 0.01.
_NOISY = Weights(state=0.1, rate=0.01)
_SPRING = Recipe("separable-hnn", 8, 1, 16, 1, 40, 10_000, 60.0, 40, 30, _NOISY, 1)
_PENDULUM = _SPRING._replace(trajectory_steps=50, window=15)
RECIPES = {
    "spring": _SPRING,
    "pendulum": _PENDULUM,
    "damped-spring": _SPRING,
    "damped-pendulum": _PENDULUM,
    "henon-heiles": Recipe("separable-hnn", 12, 2, 24, 2, 100, 4_000, 60.0),
    "double-pendulum": Recipe("structured-hnn", 8, 2, 24, 2, 100, 4_000, 60.0),
    "two-body": Recipe("pairwise-hnn", 8, 1, 24, 2, 60, 3_000, 25.0),
    "three-body": Recipe("pairwise-hnn", 8, 1, 24, 2, 60, 4_000, 45.0),
    REAL: Recipe("separable-hnn", 4, 1, 8, 1, 40, 10_000, 30.0, 40, WINDOW[REAL], Weights(state=0.03), 1),
    MEASURED: Recipe("structured-hnn", 8, 1, 16, 1, 60, 10_000, 60.0, 60, WINDOW[MEASURED], None, 2),
}
