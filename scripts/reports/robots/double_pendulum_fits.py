"""Methods to fit a double pendulum with motors, without the held-out recordings.

    least-squares   torques of filtered motions, as engineers fit them; q and tau are filtered alike
    chosen-scale    the same, with the velocity scale of dry friction that explains each recording best from the others
    low-passed      the regressor of less filtered motions is filtered, and tau with it
    stacked         the equations of both, with equal weights
    motions         the windows of `learning.measured_motions`, through an integrator with the torques; the allowed
                    error of the torques is that of the low-passed equations
    both            motions and torques in one objective (`learning.torques_beside_motions`), with friction by load

All but the first have the chosen scale. Recorded torques explain slow accelerations well and those above 3 Hz badly,
because forces act that were not recorded. They draw least squares of torques to small inertias, which are best for
torques and bad for predictions; fits to motions do the reverse.
"""

import functools
from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from dln_jax.data.encoders import low_pass
from dln_jax.data.encoders.smoothing import TRIMMED
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import select
from dln_jax.learning import measured_motions
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import GaussNewton
from dln_jax.learning.engine.problem import Problem
from dln_jax.learning.linear import design
from dln_jax.learning.measured_motions import Noise, cut_measured_windows
from dln_jax.models.joint_friction import with_joint_friction
from dln_jax.models.model import Model, Parameters
from dln_jax.models.planar_chain import make_planar_chain
from dln_jax.solvers import least_squares
from dln_jax.types import FrictionLaw, Needs
from scripts.reports.robots.torques_beside_motions import cut_torque_windows, with_torques

CUTOFF, RATE = 6.0, 100.0
"""Cut-off, Hz, at which least squares of filtered motions predict held-out recordings best (of 2, 3, 4, 6, 8, 10, 12,
25), and rate of the fitted samples, Hz."""
WINDOW = 11
"""Samples of a window and of a prediction's fitted start: 0.1 s."""
NOISE = 2e-3
"""Standard deviation of q in the fit, rad: larger than the sensor noise, to allow for unmodelled forces."""
STEPS = 8
"""Gauss-Newton steps."""
USUAL_SCALE = 0.1
"""Default velocity scale of dry friction, rad/s."""
SCALES = (0.05, 0.1, 0.2, 0.5, 1.0)
"""Candidate velocity scales, rad/s."""
SHARE = 3.0
"""Weight of torques relative to motions, both normalised by their errors; the same for all splits."""


class Logs(NamedTuple):
    """The recordings at equal steps, filtered twice, at the same times."""

    coarse: Trajectories
    """Filtered at `CUTOFF`."""
    fine: Trajectories
    """Filtered to keep the motion."""

    def of(self, recordings: Iterable[int]) -> "Logs":
        """The selected recordings."""
        indices = list(recordings)
        return Logs(*(select(data, indices) for data in self))


class Fitted(NamedTuple):
    """A model and its parameters."""

    model: Model
    parameters: Parameters


@functools.lru_cache(maxsize=16)
def ten_parameters(velocity_scale: float = USUAL_SCALE, laws: tuple[FrictionLaw, ...] = ()) -> Model:
    """The chain of two links with motors; additional friction laws add parameters."""
    needs = Needs(joints=("revolute", "revolute"), friction=True, velocity_scale=velocity_scale)
    chain = make_planar_chain(needs, armature=True, velocity_scale=velocity_scale)
    return with_joint_friction(chain, needs._replace(joint_friction=laws), dtype=jnp.float64)


def choose_scale(logs: Logs) -> float:
    """The velocity scale with the lowest leave-one-out error over the recordings."""
    errors = {}
    for scale in SCALES:
        equations = _equations(ten_parameters(scale), logs)
        squares = []
        for out in equations:
            x = _solved([equations[index] for index in equations if index != out])
            A, b = equations[out]
            squares.append((A @ x - b) ** 2)
        errors[scale] = float(np.mean(np.concatenate(squares)))
    return min(errors, key=errors.__getitem__)


def fit_torques(logs: Logs, scale: float = USUAL_SCALE) -> Fitted:
    """Least squares of filtered motions; a joint's equations are scaled by the standard deviation of its torque."""
    model = ten_parameters(scale)
    return Fitted(model, _parameters(model, _solved(_equations(model, logs).values())))


def fit_low_passed(logs: Logs, scale: float = USUAL_SCALE) -> tuple[Fitted, tuple[float, ...]]:
    """Least squares of low-passed equations, and the rms torque errors of the joints, N m."""
    model = ten_parameters(scale)
    equations = _equations(model, logs, cutoff=CUTOFF)
    x = _solved(equations.values())
    off = np.concatenate([A @ x - b for A, b in equations.values()]).reshape(-1, 2)
    sizes = logs.coarse.tau.std(axis=0) * np.sqrt(np.mean(off**2, axis=0))
    return Fitted(model, _parameters(model, x)), tuple(sizes.tolist())


def fit_stacked(logs: Logs, scale: float = USUAL_SCALE) -> Fitted:
    """Least squares of filtered motions and low-passed equations together, with equal weights."""
    model = ten_parameters(scale)
    equations = [*_equations(model, logs).values(), *_equations(model, logs, cutoff=CUTOFF).values()]
    return Fitted(model, _parameters(model, _solved(equations)))


def fit_motions(logs: Logs, scale: float = USUAL_SCALE) -> Fitted:
    """Fits motions alone; one recording selects the iteration."""
    start, off = fit_low_passed(logs, scale)
    parts = _parted(logs)
    return _trained(start, _motions(start, parts, off))


def fit_both(logs: Logs, scale: float = USUAL_SCALE) -> Fitted:
    """Fits motions and torques, with load-dependent friction; one recording selects the iteration."""
    rigid, off = fit_low_passed(logs, scale)
    model = ten_parameters(scale, ("load",))
    start = Fitted(model, model.init(jax.random.key(0)) | {"model": rigid.parameters})
    parts = _parted(logs)
    torques = [cut_torque_windows(part.coarse, WINDOW) for part in parts]
    return _trained(start, with_torques(_motions(start, parts, off), model, *torques, noise=off, share=SHARE))


def _parted(logs: Logs) -> tuple[Logs, Logs]:
    """Splits off the middle recording for validation."""
    present = np.unique(logs.fine.trajectory)
    chosen = present[len(present) // 2]
    return logs.of(present[present != chosen]), logs.of([chosen])


def _motions(start: Fitted, parts: tuple[Logs, Logs], off: tuple[float, ...]) -> Problem:
    windows = [cut_measured_windows(part.fine, WINDOW) for part in parts]
    return measured_motions.problem(*start, *windows, noise=Noise(NOISE, tau=off))


def _trained(start: Fitted, task: Problem) -> Fitted:
    return start._replace(parameters=fit(task, GaussNewton(STEPS, steps_per_dispatch=STEPS // 2)).parameters)


def _equations(model: Model, logs: Logs, *, cutoff: float | None = None) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Weighted columns and torques by recording: of coarse motions, or low-passed, of fine motions with `cutoff`."""
    data = logs.coarse if cutoff is None else logs.fine
    scale = logs.coarse.tau.std(axis=0)
    Phi = np.asarray(design(model)(_zeros(model), data.q, data.qd, data.qdd)[0])
    equations = {}
    for index in np.unique(data.trajectory):
        columns, tau = (array[data.trajectory == index] / scale for array in (np.moveaxis(Phi, 2, 1), data.tau))
        if cutoff is not None:
            columns, tau = low_passed(columns, cutoff), low_passed(tau, cutoff)
        equations[int(index)] = np.moveaxis(columns, 1, 2).reshape(-1, Phi.shape[2]), tau.ravel()
    return equations


def low_passed(values: np.ndarray, cutoff: float = CUTOFF) -> np.ndarray:
    """Low-passes one recording [N, ...] and drops its ends, where the filter has data on one side only."""
    ends = round(TRIMMED * RATE / cutoff)
    return low_pass(values.reshape(len(values), -1), rate=RATE, cutoff=cutoff)[ends:-ends].reshape(
        -1, *values.shape[1:]
    )


def _solved(equations: Iterable[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    A, b = (np.concatenate(parts) for parts in zip(*equations, strict=True))
    return least_squares.solve(A, b).x


def _parameters(model: Model, x: np.ndarray) -> Any:
    return ravel_pytree(_zeros(model))[1](jnp.asarray(x))


def _zeros(model: Model) -> Any:
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape), jax.eval_shape(model.init, jax.random.key(0)))
