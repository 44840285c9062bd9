"""From a laboratory's recording, q and the torques that were asked for, to models: identified, and learned.

1. The delay of the torques is the one with which an identified model leaves least, where it is not known.
2. q is smoothed (`data.encoders`), which gives qd; torques stay as they are, held between samples.
3. The identified model is the trigonometric one, fitted in weak form; what it leaves of each joint's equation is the
   unit in which a network's errors are measured, and so both joints count, with a motor or without.
4. The network is a structured DeLaN with the same laws of friction, by Gauss-Newton (`learning.momentum`).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.data.encoders import smooth
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import select
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import GaussNewton
from dln_jax.learning.engine.problem import Report, silent
from dln_jax.learning.momentum import (
    cut_momentum_windows,
    delay_of_torques,
    deviations,
    driven_torques,
    momentum_problem,
)
from dln_jax.learning.objectives import torque_scale
from dln_jax.learning.weak_forms import fit_momentum
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.mechanics.equations import dynamics
from dln_jax.types import FrictionLaw, InputError, Needs
from dln_jax.zoo.descriptions import Description, build, describe

LAWS: tuple[FrictionLaw, ...] = ("viscous", "coulomb")
"""Of friction, that models are given; what a plant has more of, near rest, they do not know."""
MOST_DELAY = 4
"""Samples that are tried."""
ROUNDS = 2
"""Fits, each weighted by what the one before left."""
DEGREES = {"revolute": 2, "prismatic": 0}
"""Of the identified model: rigid bodies have no more, and displacements along a level rail change nothing."""
NETWORK = {"width": 8, "depth": 2}
STEPS = 40
"""Of Gauss-Newton."""
FRICTION_START = 0.02
"""Of each coefficient of a network's friction, times the deviation of the torques."""
FLOOR = 0.05
"""Of the diagonal of a network's Cholesky factor, times its typical size."""


class Fitted(NamedTuple):
    """A model as `zoo.run.save` stores it."""

    description: Description
    parameters: Any

    @property
    def dynamics(self) -> Dynamics:
        """Of the model."""
        found = dynamics(build(self.description).energies(self.parameters))
        if not isinstance(found, Dynamics):
            raise InputError(f"a {self.description['name']} has no energy; take a model that has")
        return found


class Prepared(NamedTuple):
    """A recording that is ready to be learned from."""

    train: Trajectories
    """With rates; torques as they acted."""
    validation: Trajectories
    delay: int
    """Samples."""
    cutoff: float
    """Of the filter, Hz."""


def prepare(recording: Trajectories, *, delay: int | None = None, validation: int | None = None) -> Prepared:
    """Rates, torques as they acted, and the split into episodes to fit and one to select by.

    Args:
        recording: with its needs; of several episodes.
        delay: of the torques, samples (default: found).
        validation: index of the episode to select by (default: the middle one).

    Raises:
        InputError: a recording without needs or with one episode only.
    """
    present = np.unique(recording.trajectory)
    if recording.needs is None or len(present) < 2:
        raise InputError(
            f"the recording has {len(present)} episode(s){'' if recording.needs else ', and states no needs'}; "
            "expected at least 2, one of them to select by, and needs: record more, or cut it"
        )
    held_out = int(present[len(present) // 2] if validation is None else validation)
    if held_out not in present:
        raise InputError(f"validation is {held_out}; expected one of the episodes {present.tolist()}")
    if delay is None:
        delay = delay_of_torques(build(_linear(recording.needs)), recording, most=MOST_DELAY)
    chosen = smooth(driven_torques(recording, delay=delay))
    rest = np.setdiff1d(present, held_out)
    return Prepared(select(chosen.data, rest), select(chosen.data, [held_out]), delay, chosen.cutoff)


def _linear(needs: Needs) -> Description:
    return describe(
        "trigonometric",
        precision="f64",
        needs=needs._replace(joint_friction=LAWS, friction=False),
        degree=[DEGREES[joint] for joint in needs.joints],
    )


def identified(data: Trajectories, needs: Needs) -> Fitted:
    """The trigonometric model with viscous and dry friction, linear in its parameters; errors as of `fit_momentum`."""
    description = _linear(needs)
    model, windows = build(description), cut_momentum_windows(data)
    unit = np.asarray(torque_scale(data))
    found = fit_momentum(model, data, noise=unit)
    for _ in range(ROUNDS - 1):
        unit = deviations(Fitted(description, found.parameters).dynamics, windows)
        found = fit_momentum(model, data, noise=unit)
    return Fitted(description, found.parameters)


def learned(
    prepared: Prepared, needs: Needs, *, steps: int = STEPS, seed: int = 0, report: Report = silent, **keywords: Any
) -> Fitted:
    """A structured DeLaN with viscous and dry friction; the parameters that are best in validation.

    Args:
        prepared: the recording.
        needs: of the plant.
        steps: of Gauss-Newton.
        seed: of the initial parameters.
        report: as of `learning.engine.fit`.
        keywords: width, depth and activation, as of `models.make_delan`.

    Raises:
        InputError: as `fit`.
    """
    windows, held_out = (cut_momentum_windows(each) for each in (prepared.train, prepared.validation))
    unit = deviations(identified(prepared.train, needs).dynamics, windows)
    size = _size_of_factor(prepared.train)
    description = describe(
        "structured-delan",
        precision="f64",
        needs=needs._replace(joint_friction=LAWS, friction=False),
        diagonal_shift=_inverse_softplus(size),
        diagonal_floor=FLOOR * size,
        **{**NETWORK, **keywords},
    )
    model = build(description)
    start = _of_size(model.init(jax.random.key(seed)), size, torque=float(np.max(prepared.train.tau.std(axis=0))))
    problem = momentum_problem(model, start, windows, held_out, unit=unit, seed=seed)
    training = fit(problem, GaussNewton(steps=steps), report=report)
    return Fitted(description, training.parameters)


def _size_of_factor(data: Trajectories) -> float:
    """Typical diagonal of L in M = L Lᵀ: the root of the geometric mean of torque over acceleration."""
    torque = np.max(data.tau.std(axis=0))
    return float(np.exp(0.5 * np.mean(np.log(torque / data.qdd.std(axis=0)))))


def _of_size(parameters: Any, size: float, *, torque: float) -> Any:
    """Initial parameters whose networks give what is typical of the plant: outputs of theirs are of order 1 else."""

    def scaled(path: Any, leaf: Any) -> Any:
        name = jax.tree_util.keystr(path)
        last = f"linear_{depth}"
        if "coefficients" in name:
            return jnp.full_like(leaf, _inverse_softplus(FRICTION_START * torque))
        return leaf * (size if "cholesky" in name else torque) if last in name else leaf

    depth = max(int(name.rpartition("_")[2]) for name in parameters["model"])
    return jax.tree_util.tree_map_with_path(scaled, parameters)


def _inverse_softplus(value: float) -> float:
    return float(np.log(np.expm1(value)))
