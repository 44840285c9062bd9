"""A desktop plant explored, learned from its encoders, and swung up by what was learned: step by step."""

import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.control.closed_loop import Run
from dln_jax.control.desktop_plants import DesktopPlant
from dln_jax.control.exploration import Excitation, explore
from dln_jax.control.state_space import field_of
from dln_jax.control.swing_up_runs import model_of_maker, model_of_plant
from dln_jax.data.schema import Trajectories
from dln_jax.learning.engine.problem import Report, silent
from dln_jax.learning.recordings import Fitted, Prepared, identified, learned, prepare
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.types import InputError

MODELS = ("delan", "identified", "analytic", "known")
"""Learned; linear in its parameters; the maker's sizes without friction; the plant itself."""
TEST_SEED = 500
"""Added to the seed of what is learned from, for motions that models are judged by."""


class Obtained(NamedTuple):
    """A model, and where it is from."""

    dynamics: Dynamics
    fitted: Fitted | None
    """`None` for those that were not learned."""
    prepared: Prepared | None
    seconds: float
    """That learning took, compilation included."""


class Errors(NamedTuple):
    """Of a model along true motions that it has not seen, sum of squared errors over that of the truth."""

    torque_nmse: float
    acceleration_nmse: float


def obtain(plant: DesktopPlant, model: str, recording: Trajectories, *, seed: int, report: Report = silent) -> Obtained:
    """The model of a name.

    Args:
        plant: whose maker's model and friction are known to two of the models alone.
        model: one of `MODELS`.
        recording: that the other two are learned from.
        seed: of the network's initial parameters.
        report: of its training.

    Raises:
        InputError: an unknown name.
    """
    known: Mapping[str, Callable[[DesktopPlant], Dynamics]] = {"analytic": model_of_maker, "known": model_of_plant}
    if model not in MODELS:
        raise InputError(f"model is {model!r:.40}; choose from {', '.join(MODELS)}")
    if model in known:
        return Obtained(known[model](plant), None, None, 0.0)
    began, needs = time.perf_counter(), plant.scene.needs
    prepared = prepare(recording)
    if model == "delan":
        fitted = learned(prepared, needs, seed=seed, report=report)
    else:
        fitted = identified(prepared.train, needs)
    return Obtained(fitted.dynamics, fitted, prepared, time.perf_counter() - began)


def errors_along(plant: DesktopPlant, model: Dynamics, runs: Run) -> Errors:
    """Of a model's inverse and forward dynamics along true runs [E, N]: as the plant's states and forces are."""
    B = np.asarray(plant.scene.needs.actuation)
    x, u = (jnp.asarray(each.reshape(-1, each.shape[-1])) for each in (runs.x[:, :-1], runs.u))
    truth = field_of(model_of_plant(plant), B)

    def squares(x: Any, u: Any) -> tuple[Any, ...]:
        q, qd = jnp.split(x, 2)
        tau, qdd = jnp.asarray(B) @ u, truth(x, u)[2:]
        off = model.inverse_dynamics(q, qd, qdd) - tau, model.forward_dynamics(q, qd, tau) - qdd
        return tuple(jnp.sum(each**2) for each in (*off, tau, qdd))

    torque, acceleration, of_torque, of_acceleration = (np.sum(each) for each in jax.jit(jax.vmap(squares))(x, u))
    return Errors(float(torque / of_torque), float(acceleration / of_acceleration))


def test_motions(plant: DesktopPlant, *, seed: int, seconds: float = 12.0) -> Run:
    """True motions of another exploration, to judge models by."""
    excitation = Excitation(seconds=seconds, episodes=2, surplus=(0.0, 0.5))
    return explore(plant, plant.numbers.gains, excitation, seed=seed + TEST_SEED)[1]
