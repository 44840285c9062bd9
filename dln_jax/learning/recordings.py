"""Fits models to a recording of q and commanded torques: an identified model and a network.

1. The delay of the torques, unless known, is the one that gives an identified model the smallest residual.
2. q is smoothed (`data.encoders`), which also gives qd; torques are not filtered, and held between samples.
3. The identified model is the trigonometric one, fitted in weak form. Its residuals in the joints' equations are the
   scales of a network's errors, so that joints with and without a motor both count.
4. The network is a structured DeLaN with the same friction laws, fitted by Gauss-Newton (`learning.momentum`).
"""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.data.encoders.sampling import held_at_equal_steps
from dln_jax.data.encoders.smoothing import smooth
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import select
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import GaussNewton
from dln_jax.learning.engine.problem import ProgressReport, silent
from dln_jax.learning.momentum import (
    acceleration_misfit,
    cut_momentum_windows,
    delay_of_torques,
    deviations,
    driven_torques,
    momentum_problem,
)
from dln_jax.learning.weak_forms import fit_momentum, fit_reweighted
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.model import Model, Parameters
from dln_jax.types import FrictionLaw, InputError, Needs
from dln_jax.zoo.descriptions import Description, build, describe

LAWS: tuple[FrictionLaw, ...] = ("viscous", "coulomb")
"""Friction laws of the models; other friction of the plant, near rest, is not modelled."""
MOST_DELAY = 4
DEGREE = 2
"""Degree of the identified mass matrix in every angle: enough for rigid bodies. Displacements along a level rail have
no effect."""
CHECKED = 500
"""Number of the recording's positions for checking the mass matrix."""
NETWORK = {"width": 8, "depth": 2}
STEPS = 40
FRICTION_START = 0.02
"""Initial friction coefficients of a network, relative to the deviation of the torques."""
FLOOR = 0.05
"""Lower bound on the diagonal of a network's Cholesky factor, relative to its typical size."""


class FittedPlant(NamedTuple):
    """Description and parameters of a plant's model, as `zoo.run.save` stores them."""

    description: Description
    parameters: Any

    @property
    def dynamics(self) -> Dynamics:
        """Dynamics of the model."""
        return _dynamics(build(self.description), self.parameters)


class PreparedRecording(NamedTuple):
    """A recording that is ready for fits."""

    train: Trajectories
    """Episodes to fit, with rates and acting torques."""
    validation: Trajectories
    delay: float
    """Delay of the torques in samples."""
    cutoff: float
    """Cut-off frequency of the filter, Hz."""


def prepare(
    recording: Trajectories,
    *,
    delay: int | float | None = None,
    validation: int | None = None,
    chain: bool = False,
    cutoffs: Sequence[float] = (1.0,),
) -> PreparedRecording:
    """Computes rates and acting torques, and splits the episodes into those to fit and one for validation.

    Args:
        recording: several episodes, with the needs of the plant.
        delay: delay of the torques in samples (default: estimated).
        validation: index of the validation episode (default: the middle one).
        chain: whether the plant is one for `identified_chain`.
        cutoffs: multiples of the cut-off that `smooth` chooses; of several, the one whose identified model predicts
            validation best (`acceleration_misfit`) is taken.

    Raises:
        InputError: a recording without needs or with only one episode.
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
    needs, recording = recording.needs, held_at_equal_steps(recording)
    model = build(_chain(needs) if chain else _tree(needs))
    if delay is None:
        delay = delay_of_torques(model, recording, most=MOST_DELAY)
    driven, rest = driven_torques(recording, delay=delay), np.setdiff1d(present, held_out)
    chosen = smooth(driven)
    prepared = []
    for multiple in cutoffs:
        cutoff = multiple * chosen.cutoff
        if multiple != 1 and not cutoff < chosen.rate / 2:
            continue
        data = chosen.data if multiple == 1 else smooth(driven, cutoff).data
        prepared.append(PreparedRecording(select(data, rest), select(data, [held_out]), float(delay), cutoff))
    return prepared[0] if len(prepared) == 1 else min(prepared, key=lambda one: _misfit(model, one))


def _misfit(model: Model, prepared: PreparedRecording) -> float:
    parameters, windows = fit_momentum(model, prepared.train).parameters, cut_momentum_windows(prepared.validation)
    return float(jax.jit(lambda: acceleration_misfit(_dynamics(model, parameters), windows))())


def _dynamics(model: Model, parameters: Parameters) -> Dynamics:
    of_model = dynamics(model.energies(parameters))
    assert isinstance(of_model, Dynamics)  # models of recordings have energies
    return of_model


def _described(name: str, needs: Needs, **keywords: Any) -> Description:
    return describe(name, precision="f64", needs=needs._replace(joint_friction=LAWS, friction=False), **keywords)


def _tree(needs: Needs) -> Description:
    return _described("trigonometric", needs, degree=_degrees(needs, DEGREE))


def _chain(needs: Needs) -> Description:
    """The mass matrix of a chain on a fixed base does not depend on the first coordinate."""
    of_mass = [0, *_degrees(needs, DEGREE)[1:]]
    return _described("trigonometric", needs, degree=of_mass, potential_degree=_degrees(needs, 1))


def _planar(needs: Needs) -> list[Description]:
    """Chains whose links move in one plane, which have far fewer coefficients, for all directions of the later axes.

    Slides that come first may point anywhere.
    """
    slides, hinges = (needs.joints.count(joint) for joint in ("prismatic", "revolute"))
    if "prismatic" in needs.joints[slides:] or not hinges:
        return []
    first = [1] * (slides + 1)
    later = itertools.product((1, -1), repeat=hinges - 1)
    return [
        _described("planar-chain", needs, directions=[*first, *signs], symmetric=False, armature=True)
        for signs in later
    ]


def _degrees(needs: Needs, degree: int) -> list[int]:
    return [degree if joint == "revolute" else 0 for joint in needs.joints]


def identified(data: Trajectories, needs: Needs) -> FittedPlant:
    """Fits the trigonometric model with viscous and dry friction; errors as for `fit_momentum`.

    Args:
        data: recording with rates and acting torques.
    """
    form = _tree(needs)
    errors = fit_momentum(build(form), data).errors
    return FittedPlant(form, fit_momentum(build(form), data, noise=np.sqrt(np.mean(errors**2, axis=0))).parameters)


def identified_chain(prepared: PreparedRecording, needs: Needs) -> FittedPlant:
    """Fits a chain of rigid bodies on a fixed base, in relative coordinates, for which fewer motions suffice.

    Whether all links move in one plane, which axes point the other way, and how the equations are weighted is decided
    by the smallest `acceleration_misfit` in the validation episode. Models whose mass matrix is not positive definite
    at the recording's positions are left out.

    Raises:
        InputError: as for `fit_momentum`, or all models are left out.
    """
    held_out = cut_momentum_windows(prepared.validation)
    positions = np.concatenate([prepared.train.q, prepared.validation.q])
    positions = positions[:: max(len(positions) // CHECKED, 1)]
    best, least, share = None, np.inf, 0.0
    for form in (*_planar(needs), _chain(needs)):
        model = build(form)

        @jax.jit
        def judged(parameters: Parameters, model: Model = model) -> tuple[Array, Array]:
            plant = _dynamics(model, parameters)
            masses = jax.vmap(plant.mass_matrix)(jnp.asarray(positions))
            return jnp.linalg.eigvalsh(masses)[:, 0] > 0, acceleration_misfit(plant, held_out)

        for fitted in (fit_momentum(model, prepared.train), fit_reweighted(model, prepared.train)):
            definite, misfit = map(np.asarray, judged(fitted.parameters))
            share = max(share, float(np.mean(definite)))
            if definite.all() and misfit < least:
                best, least = FittedPlant(form, fitted.parameters), float(misfit)
    if best is None:
        raise InputError(
            f"the identified mass matrix is positive definite at {share:.1%} of the recording's positions; expected "
            "all: record more or livelier motions of every joint"
        )
    return best


def learned(
    prepared: PreparedRecording,
    needs: Needs,
    *,
    steps: int = STEPS,
    seed: int = 0,
    report: ProgressReport = silent,
    **keywords: Any,
) -> FittedPlant:
    """Trains a structured DeLaN with viscous and dry friction and keeps the parameters that are best in validation.

    Args:
        report: as for `learning.engine.fit`.
        keywords: width, depth and activation, as for `models.make_delan`.

    Raises:
        InputError: as for `fit`.
    """
    windows, held_out = map(cut_momentum_windows, (prepared.train, prepared.validation))
    unit = deviations(identified(prepared.train, needs).dynamics, windows)
    size = _size_of_factor(prepared.train)
    diagonal = {"diagonal_shift": _inverse_softplus(size), "diagonal_floor": FLOOR * size}
    description = _described("structured-delan", needs, **diagonal, **{**NETWORK, **keywords})
    model = build(description)
    start = _of_size(model.init(jax.random.key(seed)), size, torque=float(np.max(prepared.train.tau.std(axis=0))))
    problem = momentum_problem(model, start, windows, held_out, unit=unit, seed=seed)
    training = fit(problem, GaussNewton(steps=steps), report=report)
    return FittedPlant(description, training.parameters)


def _size_of_factor(data: Trajectories) -> float:
    """Typical diagonal of L in M = L Lᵀ: the root of the geometric mean of torque over acceleration."""
    torque = np.max(data.tau.std(axis=0))
    return float(np.exp(0.5 * np.mean(np.log(torque / data.qdd.std(axis=0)))))


def _of_size(parameters: Any, size: float, *, torque: float) -> Any:
    """Scales the output layers of the initial networks, of order 1, to typical values of the plant."""

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
