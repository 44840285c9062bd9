"""Fits models of dynamics to trajectories: builds the problem that `engine.fit` solves, and chooses its settings.

    training = fit(problem(model, sets, objective), GaussNewton())

`suited_network` chooses the structured network, its optimiser and its number of samples for an arm of many joints. The
table has the mean nMSE on twelve unseen motions of the simulated seven-axis arm (viscous friction, no noise), after
half a minute of processor time. Two numbers are two seeds.

    motions of 10 s                                15               30      75
    independent equations per parameter             4                8      19
    16 units, Gauss-Newton, 1,480 samples    0.026, 0.035         0.025   0.024
    64 x 64, AdamW, all samples (6,000 steps) 0.062, 0.059        0.023   0.0075

With 15 motions, wider and deeper small networks (16 x 16, 32) reached the same 0.025 more slowly, 8 units reached
0.056, and a ridge did not help. A Gauss-Newton step takes about N d P² operations to form JᵀJ, and neighbouring samples
of a motion are redundant, so a subset is enough. Capacity limits a small network and the information in the motions
limits a large one, so the number of independent equations decides between them.

`summed_with_friction` finds friction forces that the data cannot distinguish from potential forces.
If a potential can have any constant slope, it also represents the offset of friction, and the dry friction of a joint
that moves in one direction only. Torques then determine only their sum. A polynomial of a prismatic displacement is
such a potential. A network of the cosine and sine of an angle is one if the recorded angles leave a gap in the circle.

Other friction can be distinguished. Over a closed path in the states (q, qd) it dissipates work, but forces of a
Lagrangian do not: terms linear in qd, A(q)ᵀ qd, only add the gyroscopic force (dA/dq - dA/dqᵀ) qd with zero power.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import Split
from dln_jax.learning import objectives
from dln_jax.learning.engine import optimisers
from dln_jax.learning.engine.problem import Problem, arrays_of
from dln_jax.learning.linear import shapes_of
from dln_jax.learning.objectives import TORQUE, Objective
from dln_jax.learning.uncertainty import effective_samples
from dln_jax.models.model import Model, Parameters, make_delan
from dln_jax.solvers.normal_equations import count
from dln_jax.types import Needs, SampleVector, require_seed

MANY_JOINTS = 4
"""Arms with fewer joints get a small network and all their samples."""
WIDTH = 16
"""Width of the hidden layer shared by mass matrix and potential."""
ROWS_PER_PARAMETER = 14
"""Equations per parameter in a Gauss-Newton step. For 16 x 16 units, seven did equally well."""
MOST_INDEPENDENT = 6
"""With more independent equations per parameter of the small network, a large one trained with Adam is better."""


CIRCLE = 6.0
"""Range of angles that counts as a full circle, rad: small networks do not bridge the last 0.28 rad."""


def problem(model: Model, sets: Split, objective: Objective = TORQUE, *, seeds: int | Sequence[int] = 0) -> Problem:
    """Builds the problem of fitting a model to an objective, in the model's precision.

    Args:
        sets: samples for training, for selecting the parameters, and for monitoring.
        objective: residual to minimise, from `learning.objectives`.
        seeds: seeds for initial parameters and sample order; several train in one program and add an axis to results.

    Raises:
        InputError: the data cannot determine the model, lack a key of the objective, or overflow in its precision.
    """
    for seed in (seeds,) if isinstance(seeds, int) else seeds:
        require_seed(seed)
    scale, (fitted, selected_by, monitored) = _read(model, sets, objective)
    held_out = tuple(map(lambda *pair: jnp.concatenate(pair), selected_by, monitored))

    def residual(parameters: Parameters, *sample: Array) -> Array:
        return objective.residual(model.energies(parameters), *sample) / scale

    def score(parameters: Parameters) -> tuple[Array, Array]:
        squares = _squares(objective, model, parameters, held_out, scale)
        return squares[: len(selected_by[0])].mean(), squares[len(selected_by[0]) :].mean()

    if isinstance(seeds, int):
        return Problem(residual, jax.jit(model.init)(jax.random.key(seeds)), fitted, score, seeds)
    numbers = jnp.asarray(seeds)
    initial = jax.jit(lambda seeds: jax.lax.map(lambda seed: model.init(jax.random.key(seed)), seeds))
    return Problem(residual, initial(numbers), fitted, score, numbers)


def validation_errors(model: Model, sets: Split, parameters: Parameters, objective: Objective = TORQUE) -> SampleVector:
    """Returns the squared error of every validation sample; their mean selects the parameters."""
    scale, (_, batch, _) = _read(model, sets, objective)
    return np.asarray(jax.jit(lambda theta: _squares(objective, model, theta, batch, scale))(parameters))


def suited_optimiser(model: Model, sets: Split, objective: Objective = TORQUE) -> tuple[str, str]:
    """Returns the name of the optimiser that suits the size of model and data, and the reason."""
    return optimisers.suited(shapes_of(model), len(sets.train.t), len(objective.scale(sets.train)))


class Suited(NamedTuple):
    """Settings of a structured network."""

    optimizer: str
    """gauss-newton or adam."""
    keywords: dict[str, int | bool]
    """Keywords of `make_delan`: width, depth and shared_trunk."""
    steps: int
    """Number of optimiser steps, which take half a minute."""
    samples: int | None
    """Number of samples drawn for the fit; `None` for all."""
    reason: str


def suited_network(needs: Needs, train: Trajectories) -> Suited:
    """Returns the settings for an arm of many joints, from its needs and the information in the training motions."""
    d = needs.degrees_of_freedom
    small = {"width": WIDTH, "depth": 1, "shared_trunk": True}
    size = count(shapes_of(make_delan(needs, **small)))
    independent = independent_equations(train)
    reason = f"{independent:,} independent equations for the {size:,} parameters of a small network"
    if independent > MOST_INDEPENDENT * size:
        large = {"width": 64, "depth": 2, "shared_trunk": False}
        return Suited("adam", large, 6_000, None, f"{reason}, so a large network learns more")
    samples = ROWS_PER_PARAMETER * size // d
    drawn = f"; {samples:,} of {len(train.t):,} samples are used" if samples < len(train.t) else ""
    return Suited("gauss-newton", small, 40, samples, reason + drawn)


def independent_equations(data: Trajectories) -> int:
    """Returns d times the effective sample size of the accelerations (median of joints), for any sampling rate."""
    counts = [effective_samples(column - column.mean(), data.trajectory) for column in data.qdd.T]
    return round(data.degrees_of_freedom * float(np.median(counts)))


def summed_with_friction(needs: Needs, data: Trajectories, *, network: bool) -> list[int]:
    """Returns the joints, counted from 1, for which the data determine only the sum of gravity and friction.

    Args:
        needs: needs of the model; gravity means a potential.
        data: the training data.
        network: whether the potential is a network; otherwise it is a polynomial, of cos q and sin q for angles.
    """
    laws = set(needs.joint_friction)
    rates = data.qd if needs.joint_map is None else data.qd @ np.transpose(needs.joint_map)
    one_way = np.ptp(np.sign(rates), axis=0) == 0
    constant = ("offset" in laws) | one_way & bool(laws - {"viscous", "load"})
    takes = (np.array(needs.joints) == "prismatic") | network & (np.ptp(data.q, axis=0) < CIRCLE)
    return (np.flatnonzero(needs.gravity & takes & constant) + 1).tolist()


def without_offset(needs: Needs) -> Needs:
    """Returns the needs without the offset of friction."""
    return needs._replace(joint_friction=tuple(law for law in needs.joint_friction if law != "offset"))


def _read(model: Model, sets: Split, objective: Objective) -> tuple[np.ndarray, list[tuple[Array, ...]]]:
    """Returns the scale of the residuals and the arrays of each set."""
    dtype = jnp.result_type(*jax.tree.leaves(shapes_of(model)))
    return objective.scale(sets.train).astype(dtype), [arrays_of(data, objective.keys, dtype) for data in sets]


def _squares(objective: Objective, model: Model, parameters: Any, batch: tuple[Array, ...], scale: np.ndarray) -> Array:
    """Returns the squared error of each sample of a batch, in the units of the validation error."""
    errors = objectives.residuals(objective, model.energies(parameters), batch)
    return jnp.sum((errors if objective.selects_by == "torque" else errors / scale) ** 2, axis=1)
