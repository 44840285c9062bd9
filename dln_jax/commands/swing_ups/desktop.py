"""Learns a desktop plant from its encoders and evaluates the models for the swing-up."""

import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.commands.swing_ups.any_plant import model_of
from dln_jax.control.closed_loop import ClosedLoopRun, Controller, simulate
from dln_jax.control.desktop_plants import DesktopPlant, model_of_plant, nominal_model, simulated_plant
from dln_jax.control.plants.exploring import Exploration, explore
from dln_jax.control.state_space import field_of
from dln_jax.data.schema import Trajectories
from dln_jax.learning.engine.problem import ProgressReport, silent
from dln_jax.learning.recordings import FittedPlant, PreparedRecording, identified, learned, prepare
from dln_jax.mechanics.dynamics import Dynamics

MODELS = ("delan", "identified", "analytic", "known")
"""A learned network; a fit linear in its parameters; nominal dimensions without friction; the plant itself."""
TEST_SEED = 500
"""Offset of the seed for test motions."""


class Obtained(NamedTuple):
    """A model and its origin."""

    dynamics: Dynamics
    fitted: FittedPlant | None
    """`None` for models that are not learned."""
    prepared: PreparedRecording | None
    seconds: float
    """Learning time, compilation included."""


def obtain(
    plant: DesktopPlant, model: str, recording: Trajectories, *, seed: int, report: ProgressReport = silent
) -> Obtained:
    """The model with this name.

    Args:
        plant: the plant; only "analytic" and "known" use its nominal model and friction.
        model: one of `MODELS`.
        recording: data for learning the other two models.
        seed: seed of the network's initial parameters.
        report: called with the progress of its training.
    """
    known = {"analytic": nominal_model, "known": model_of_plant}
    if model in known:
        return Obtained(known[model](plant), None, None, 0.0)
    began, needs = time.perf_counter(), plant.scene.needs
    prepared = prepare(recording)
    if model == "delan":
        fitted = learned(prepared, needs, seed=seed, report=report)
    else:
        fitted = identified(prepared.train, needs)
    return Obtained(fitted.dynamics, fitted, prepared, time.perf_counter() - began)


def errors_along(plant: DesktopPlant, model: Dynamics, runs: ClosedLoopRun) -> tuple[float, float]:
    """Normalised errors of a model's torques and accelerations along true runs [E, N].

    They are sums of squared errors over sums of squares of the truth, at the plant's own states and forces.
    """
    B = np.asarray(plant.scene.needs.actuation)
    x, u = (jnp.asarray(array.reshape(-1, array.shape[-1])) for array in (runs.x[:, :-1], runs.u))
    truth = field_of(model_of_plant(plant), B)

    def squares(x: Array, u: Array) -> tuple[Array, ...]:
        q, qd = jnp.split(x, 2)
        tau, qdd = jnp.asarray(B) @ u, truth(x, u)[2:]
        off = model.inverse_dynamics(q, qd, qdd) - tau, model.forward_dynamics(q, qd, tau) - qdd
        return tuple(jnp.sum(array**2) for array in (*off, tau, qdd))

    torque, acceleration, of_torque, of_acceleration = (np.sum(array) for array in jax.jit(jax.vmap(squares))(x, u))
    return float(torque / of_torque), float(acceleration / of_acceleration)


def recorded(plant: DesktopPlant, *, seconds: float, seed: int) -> Trajectories:
    """Recording of an exploration of the plant."""
    return explore(simulated_plant(plant, seed=seed), model_of, Exploration(seconds=seconds), seed=seed).recording


def test_motions(plant: DesktopPlant, *, seed: int, seconds: float = 12.0) -> ClosedLoopRun:
    """True motions [E, N] under the torques of another exploration, replayed without noise from hanging."""
    blind, seed = Exploration(seconds=seconds, blind=(0.4, 0.8), surplus=()), seed + TEST_SEED
    recording = explore(simulated_plant(plant, seed=seed), model_of, blind, seed=seed).recording
    B = np.asarray(plant.scene.needs.actuation)
    episodes = [recording.tau[recording.trajectory == k] @ B for k in np.unique(recording.trajectory)]
    samples = min(map(len, episodes))

    def replay(u: Array) -> ClosedLoopRun:
        return simulate(
            field_of(model_of_plant(plant), B),
            Controller(jnp.asarray(0), lambda k, t, y: (k + 1, u[k])),
            np.array([0.0, np.pi, 0.0, 0.0]),
            seconds=samples / plant.rate,
            rate=plant.rate,
            controls=B.shape[1],
            hardware=plant.hardware._replace(control_noise=0.0),
            substeps=plant.substeps,
        )

    return jax.tree.map(np.asarray, jax.jit(jax.vmap(replay))(np.stack([u[:samples] for u in episodes])))
