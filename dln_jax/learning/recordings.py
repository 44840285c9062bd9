"""Fits models to recordings of q and commanded torques, in four steps.

1. An unknown delay of the torques is chosen by the smallest residual of an identified model.
2. q is smoothed (`data.encoders`), which also gives qd. Torques are not filtered, and are held between samples.
3. A trigonometric model is fitted by the weak form of its equations (`learning.momentum`). Its residuals set the scale
   of a network's errors in each joint, so that joints with and without a motor have similar weight.
4. The network is a structured DeLaN with the same friction laws, fitted to the same windows by Gauss-Newton.
"""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.data.encoders.sampling import delay_held, held_at_equal_steps
from dln_jax.data.encoders.smoothing import smooth
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import select
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import GaussNewton
from dln_jax.learning.engine.problem import ProgressReport, arrays_of, selected_by, silent
from dln_jax.learning.momentum import (
    acceleration_misfit,
    cut_momentum_windows,
    fit_momentum,
    momentum_errors,
    window_errors,
)
from dln_jax.learning.objectives import torque_scale
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.model import Model, Parameters
from dln_jax.types import FrictionLaw, InputError, Needs
from dln_jax.zoo.descriptions import Description, build, describe

SURE = 4.0
"""A delay within this number of standard errors of a whole number is rounded."""
LAWS: tuple[FrictionLaw, ...] = ("viscous", "coulomb")
"""Friction laws of the models; other friction near rest is not modelled."""
MOST_DELAY = 4
DEGREE = 2
"""Degree of the identified mass matrix in each angle, which is enough for rigid bodies. Displacements along a level
rail have no effect."""
CHECKED = 500
"""Number of recorded positions for checking the mass matrix."""
WIDTH, DEPTH = 8, 2
"""Size of the network."""
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
        return dynamics(build(self.description).energies(self.parameters))  # type: ignore[return-value]  # it has energies


class PreparedRecording(NamedTuple):
    """A recording with rates and acting torques, ready for fits."""

    train: Trajectories
    """Episodes to fit, with rates and acting torques."""
    validation: Trajectories
    delay: float
    """Delay of the torques in samples."""
    cutoff: float
    """Cut-off frequency of the filter, Hz."""


def driven_torques(data: Trajectories, *, delay: float) -> Trajectories:
    """Converts commanded torques, which are delayed and held between samples, to torques that act at the samples.

    The torque at a sample is the mean of the torques held before and after it. The first torques of a trajectory,
    before the first command, are zero.

    Args:
        delay: delay of the commands in samples.

    Raises:
        InputError: a delay that is negative or not finite.
    """
    acting = np.zeros_like(data.tau)
    for index in np.unique(data.trajectory):
        rows = np.flatnonzero(data.trajectory == index)
        held = delay_held(data.tau[rows], float(delay))
        acting[rows] = (np.pad(held[:-1], ((1, 0), (0, 0))) + held) / 2
    return data._replace(tau=acting)


def delay_of_torques(model: Model, recording: Trajectories) -> float:
    """Estimates the delay of torques in samples by the smallest residuals of a model linear in its parameters.

    Commands of hardware may take effect between samples. The residuals r of the fit are linear in the torques, so
    between whole delays k and k + 1, up to `MOST_DELAY`,

        r = r_k - s D,    D = r_k - r_{k+1},    s = r_k . D / D . D

    The contributions of the episodes to r . D give the standard error of s. A delay within `SURE` standard errors of a
    whole number is rounded.

    Args:
        model: model that is linear in its parameters, such as `make_trigonometric`.
        recording: q and the commanded torques.

    Raises:
        InputError: as for `smooth` and `fit_momentum`.
    """
    smoothed = smooth(recording)
    unit = torque_scale(smoothed.data)

    def errors(delay: int) -> np.ndarray:
        late = smooth(driven_torques(recording, delay=delay), smoothed.cutoff).data
        return fit_momentum(model, late, noise=unit)[1] / unit

    of_delays = [errors(whole) for whole in range(MOST_DELAY + 1)]
    episode = cut_momentum_windows(smoothed.data).trajectory
    candidates = []
    for whole, (earlier, later) in enumerate(itertools.pairwise(of_delays)):
        change = earlier - later
        total = float(np.sum(change**2)) or np.inf
        share = float(np.clip(np.sum(earlier * change) / total, 0.0, 1.0))
        left = earlier - share * change
        # Errors of windows in one episode are correlated, so each episode counts once.
        parts = [np.sum((left * change)[episode == one]) for one in np.unique(episode)]
        count = len(parts)
        error = np.sqrt(np.sum(np.square(parts)) * count / (count - 1)) / total if count > 1 else np.inf
        candidates.append((float(np.sum(left**2)), whole + share, error))
    _, delay, error = min(candidates)
    return float(round(delay)) if abs(delay - round(delay)) < SURE * error else delay


def prepare(
    recording: Trajectories, *, delay: float | None = None, chain: bool = False, cutoffs: Sequence[float] = (1.0,)
) -> PreparedRecording:
    """Computes rates and acting torques, and holds out the middle episode for validation.

    Args:
        recording: several episodes, with the needs of the plant.
        delay: delay of the torques in samples (default: estimated).
        chain: whether the plant is for `identified_chain`.
        cutoffs: multiples of the cut-off that `smooth` chooses; the validation error of the identified model
            (`acceleration_misfit`) chooses between several.

    Raises:
        InputError: a recording without needs or with only one episode.
    """
    present = np.unique(recording.trajectory)
    if recording.needs is None or len(present) < 2:
        raise InputError(
            f"the recording has {len(present)} episode(s){'' if recording.needs else ' and no needs'}; "
            "expected at least 2, one of them for validation, and needs: record more, or cut it"
        )
    held_out = int(present[len(present) // 2])
    model, recording = build(_trigonometric(recording.needs, chain=chain)), held_at_equal_steps(recording)
    if delay is None:
        delay = delay_of_torques(model, recording)
    driven, rest = driven_torques(recording, delay=delay), np.setdiff1d(present, held_out)
    usual = smooth(driven)
    candidates = []
    for multiple in cutoffs:
        cutoff = multiple * usual.cutoff
        if multiple != 1 and not cutoff < usual.rate / 2:
            continue
        data = usual.data if multiple == 1 else smooth(driven, cutoff).data
        candidates.append(PreparedRecording(select(data, rest), select(data, [held_out]), float(delay), cutoff))

    def misfit(candidate: PreparedRecording) -> float:
        plant = dynamics(model.energies(fit_momentum(model, candidate.train)[0]))
        return float(jax.jit(lambda: acceleration_misfit(plant, cut_momentum_windows(candidate.validation)))())

    return candidates[0] if len(candidates) == 1 else min(candidates, key=misfit)


def _described(name: str, needs: Needs, **keywords: Any) -> Description:
    return describe(name, precision="f64", needs=needs._replace(joint_friction=LAWS, friction=False), **keywords)


def _trigonometric(needs: Needs, *, chain: bool) -> Description:
    """Describes the trigonometric model; a chain's mass matrix does not depend on the first coordinate."""
    turns = [int(joint == "revolute") for joint in needs.joints]
    degree = [DEGREE * turn for turn in turns]
    if chain:
        return _described("trigonometric", needs, degree=[0, *degree[1:]], potential_degree=turns)
    return _described("trigonometric", needs, degree=degree)


def _chains(needs: Needs) -> list[Description]:
    """Describes planar chains of rigid bodies, with both directions of each later axis, and a general chain.

    Planar chains have far fewer coefficients. Slides at the base may point anywhere.
    """
    slides, hinges = (needs.joints.count(joint) for joint in ("prismatic", "revolute"))
    planar = []
    if hinges and "prismatic" not in needs.joints[slides:]:
        for signs in itertools.product((1, -1), repeat=hinges - 1):
            directions = [*[1] * (slides + 1), *signs]
            planar.append(_described("planar-chain", needs, directions=directions, symmetric=False, armature=True))
    return [*planar, _trigonometric(needs, chain=True)]


def identified(data: Trajectories, needs: Needs) -> FittedPlant:
    """Fits the trigonometric model with viscous and dry friction; errors as for `fit_momentum`.

    Args:
        data: recording with rates and acting torques.
    """
    description = _trigonometric(needs, chain=False)
    model = build(description)
    _, errors, _ = fit_momentum(model, data)
    parameters, _, _ = fit_momentum(model, data, noise=np.sqrt(np.mean(errors**2, axis=0)))
    return FittedPlant(description, parameters)


def identified_chain(prepared: PreparedRecording, needs: Needs) -> FittedPlant:
    """Fits a chain of rigid bodies on a fixed base, in relative coordinates, which needs fewer motions.

    The smallest `acceleration_misfit` in the validation episode decides whether all links move in one plane, which axes
    have the opposite direction, and how the equations are weighted. Models with an indefinite mass matrix at the
    recorded positions are left out.

    Raises:
        InputError: as for `fit_momentum`, or all models are left out.
    """
    held_out = cut_momentum_windows(prepared.validation)
    positions = np.concatenate([prepared.train.q, prepared.validation.q])
    positions = positions[:: max(len(positions) // CHECKED, 1)]
    best, least, share = None, np.inf, 0.0
    for description in _chains(needs):
        model = build(description)

        @jax.jit
        def judge(parameters: Parameters, model: Model = model) -> tuple[Array, Array]:
            plant = dynamics(model.energies(parameters))
            masses = jax.vmap(plant.mass_matrix)(jnp.asarray(positions))
            return jnp.linalg.eigvalsh(masses)[:, 0] > 0, acceleration_misfit(plant, held_out)

        for reweighted in (False, True):
            parameters, _, _ = fit_momentum(model, prepared.train, reweighted=reweighted)
            definite, misfit = map(np.asarray, judge(parameters))
            share = max(share, float(np.mean(definite)))
            if definite.all() and misfit < least:
                best, least = FittedPlant(description, parameters), float(misfit)
    if best is None:
        raise InputError(
            f"the identified mass matrix is positive definite at only {share:.1%} of the recorded positions; record "
            "more or faster motions of every joint"
        )
    return best


def learned(
    prepared: PreparedRecording, needs: Needs, *, seed: int = 0, report: ProgressReport = silent
) -> FittedPlant:
    """Trains a structured DeLaN with viscous and dry friction, and keeps the best parameters by validation.

        r_w = [integral w (s - tau) dt - integral w' p dt] / unit_w

    Args:
        report: as for `learning.engine.fit`.

    Raises:
        InputError: as for `fit`.
    """
    windows, held_out = map(cut_momentum_windows, (prepared.train, prepared.validation))
    linear = identified(prepared.train, needs).dynamics
    unit = jnp.sqrt(jnp.mean(jax.jit(lambda: window_errors(linear, windows))() ** 2, axis=0))
    tau, qdd = (getattr(prepared.train, name).std(axis=0) for name in ("tau", "qdd"))
    torque = float(np.max(tau))
    # The typical diagonal of L in M = L Lᵀ: the root of the geometric mean of torque over acceleration.
    size = float(np.exp(0.5 * np.mean(np.log(torque / qdd))))
    description = _described(
        "structured-delan", needs, diagonal_shift=_inverse_softplus(size), diagonal_floor=FLOOR * size,
        width=WIDTH, depth=DEPTH,
    )  # fmt: skip
    model = build(description)

    def typical(path: Any, leaf: Array) -> Array:
        """Scales the output layers of the initial networks, of order 1, to the plant."""
        name = jax.tree_util.keystr(path)
        if "coefficients" in name:
            return jnp.full_like(leaf, _inverse_softplus(FRICTION_START * torque))
        return leaf * (size if "cholesky" in name else torque) if f"linear_{DEPTH}" in name else leaf

    def residual(parameters: Parameters, *window: Array) -> Array:
        return momentum_errors(dynamics(model.energies(parameters)), *window, dt=windows.dt) / unit

    start = jax.tree_util.tree_map_with_path(typical, model.init(jax.random.key(seed)))
    fitted, selecting = (arrays_of(part, ("q", "qd", "impulse")) for part in (windows, held_out))
    training = fit(selected_by(selecting, residual, start, fitted, seed), GaussNewton(steps=STEPS), report=report)
    return FittedPlant(description, training.parameters)


def _inverse_softplus(value: float) -> float:
    return float(np.log(np.expm1(value)))
