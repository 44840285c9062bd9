"""Datasets sampled from scenes, with exact rates, torques and force decomposition, in float64."""

import functools
import os
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dln_jax.data import schema
from dln_jax.data.schema import Trajectories
from dln_jax.errors import require_memory
from dln_jax.files import cache_folder
from dln_jax.mechanics import lagrangian
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.integrators import adaptive_rollout, second_order
from dln_jax.precision import in_float64
from dln_jax.scenes.datasets.letters import LETTERS, letter_path, require_finite
from dln_jax.scenes.pendulums import joint_angles, two_link_arm
from dln_jax.scenes.scene import Scene, closed_form_forward_dynamics
from dln_jax.types import InputError, require_seed

CHARACTERS_TEST = ("e", "q", "v")
"""Test letters of the published protocol."""

_VERSION = 1  # of the generators' output; a new version makes a new file instead of reading a stale one


def default_data(scene: Scene) -> Trajectories:
    """Returns letters for the two-link arm, else random states that exercise every term; cached once generated."""
    kind, generate = ("characters", characters) if scene.name == "two-link-arm" else ("uniform", lambda: uniform(scene))
    try:
        path = cache_folder() / f"{scene.name}-{kind}-{_VERSION}.npz"
    except InputError:
        if os.environ.get("XDG_CACHE_HOME"):
            raise
        return generate()  # for a user without a home folder
    if not path.exists():
        schema.save(path, generate(), overwrite=True)  # two processes may do so at the same time: one rename wins
    return schema.load(path)


@in_float64
def characters(*, letters: Sequence[str] = LETTERS, dt: float = 0.04) -> Trajectories:
    """Returns letters written by the tip of the two-link arm, one trajectory each, sampled every `dt` s.

    The outlines come from matplotlib's bundled font, smoothed. Inverse kinematics, differentiation and the closed-form
    equations of motion give exact angles, rates and torques from the tip's path.
    """
    require_finite(dt=dt)
    durations, positions = zip(*map(letter_path, letters), strict=True)
    times = [np.arange(0.0, duration, dt) for duration in durations]

    @jax.jit
    def states(position, t):
        def angles(t):
            return joint_angles(position(t))

        def rates(t):
            return jax.jvp(angles, (t,), (jnp.ones_like(t),))

        def motion(t):
            (q, qd), (_, qdd) = jax.jvp(rates, (t,), (jnp.ones_like(t),))
            return q, qd, qdd

        return jax.vmap(motion)(t)

    # All letters use the longest duration and thus share one compilation. A path rests after its end.
    longest = dt * np.arange(max(map(len, times)))
    motions = [states(position, longest) for position in positions]
    cut = [[np.asarray(values)[: len(t)] for values in motion] for motion, t in zip(motions, times, strict=True)]
    q, qd, qdd = map(np.concatenate, zip(*cut, strict=True))
    trajectory = np.repeat(np.arange(len(times)), [len(t) for t in times])
    return completed(two_link_arm(), np.concatenate(times), q, qd, qdd, trajectory, np.array(list(letters)))


@in_float64
def uniform(
    scene: Scene,
    *,
    samples: int = 3000,
    position_bound: float = np.pi,
    rate_bound: float = 5.0,
    acceleration_bound: float = 20.0,
    control_bound: float = 10.0,
    seed: int = 0,
) -> Trajectories:
    """Returns independent random states, one per trajectory, uniform in a box symmetric about zero.

    Bounds are in rad or m, 1/s, 1/s² and N m or N. For a fully actuated scene accelerations are drawn. Otherwise
    controls are drawn and the accelerations computed.
    """
    require_finite(samples=samples, position_bound=position_bound, rate_bound=rate_bound)
    require_finite(acceleration_bound=acceleration_bound, control_bound=control_bound)
    require_seed(seed)
    _require_room(samples, scene)
    d = scene.needs.degrees_of_freedom
    random = np.random.default_rng(seed)
    q, qd = (random.uniform(-bound, bound, (samples, d)) for bound in (position_bound, rate_bound))
    if scene.needs.actuation is None:
        qdd = random.uniform(-acceleration_bound, acceleration_bound, (samples, d))
    else:
        matrix = jnp.asarray(scene.needs.actuation)
        control = random.uniform(-control_bound, control_bound, (samples, matrix.shape[1]))
        qdd = _batched(closed_form_forward_dynamics, scene)(q, qd, control @ matrix.T)
    order = np.arange(samples)
    label = np.array([f"state-{index}" for index in order])
    return completed(scene, np.zeros(samples), q, qd, np.asarray(qdd), order, label)


@in_float64
def free_swing(
    scene: Scene,
    *,
    starts: Float[np.ndarray, "K d"] | None = None,
    trajectories: int = 10,
    steps: int = 400,
    dt: float = 0.02,
    tolerance: float = 1e-10,
    seed: int = 0,
) -> Trajectories:
    """Returns motions from rest without torque, integrated adaptively (Dormand-Prince 8) to `tolerance`.

    Without `starts` [K, d], `trajectories` starting postures are drawn within ±π/2 (rad or m).

    Raises:
        InputError: the integration does not finish.
    """
    require_finite(trajectories=trajectories, steps=steps, dt=dt, tolerance=tolerance)
    require_seed(seed)
    _require_room(trajectories * steps, scene)
    if starts is None:
        random = np.random.default_rng(seed)
        starts = random.uniform(-np.pi / 2, np.pi / 2, (trajectories, scene.needs.degrees_of_freedom))
    t = dt * np.arange(steps)
    return swings(scene, t, *rollouts(scene, starts, np.zeros_like(starts), t, tolerance=tolerance))


def _require_room(samples: int, scene: Scene) -> None:
    # Ten arrays of the schema, and the same amount for intermediate results.
    require_memory(f"{samples:,} samples", 160.0 * samples * scene.needs.degrees_of_freedom)


def swings(scene: Scene, t, q: Float[np.ndarray, "K T d"], qd: Float[np.ndarray, "K T d"]) -> Trajectories:
    """Returns motions without torque at common times t [T]; accelerations are computed from the states."""
    count, times, d = q.shape
    q, qd = q.reshape(-1, d), qd.reshape(-1, d)
    qdd = np.asarray(_batched(closed_form_forward_dynamics, scene)(q, qd, np.zeros_like(q)))
    label = np.array([f"swing-{index}" for index in range(count)])
    data = completed(scene, np.tile(t, count), q, qd, qdd, np.repeat(np.arange(count), times), label)
    return data._replace(tau=np.zeros_like(q))


@in_float64
def rollouts(
    scene: Scene,
    q: Float[np.ndarray, "K d"],
    qd: Float[np.ndarray, "K d"],
    t: Float[np.ndarray, " T"],
    *,
    tolerance: float = 1e-10,
) -> tuple[Float[np.ndarray, "K T d"], Float[np.ndarray, "K T d"]]:
    """Returns reference motions of a scene without torque from K states: q and qd at the times t, which start at 0.

    Raises:
        InputError: the integration does not finish.
    """
    field = second_order(lambda t, q, qd: closed_form_forward_dynamics(scene, q, qd, jnp.zeros_like(q)))

    @jax.jit
    @jax.vmap
    def solve(q, qd):
        return adaptive_rollout(field, (q, qd), jnp.asarray(t), tolerance=tolerance)

    motions, successful = solve(q, qd)
    if not bool(successful.all()):
        raise InputError(
            f"the integration failed at tolerance {tolerance:g}; raise the tolerance or shorten the motion"
        )
    return np.asarray(motions[0]), np.asarray(motions[1])


def completed(scene: Scene, t, q, qd, qdd, trajectory, label) -> Trajectories:
    """Adds exact torques, momenta and force decomposition to a motion of a scene; arrays as in the schema."""

    def momentum(scene: Scene, q, qd, qdd):
        return jax.jvp(functools.partial(lagrangian.momentum, scene.lagrangian), (q, qd), (qd, qdd))

    # Compiled separately: fusion would change the last digits of the datasets.
    known = dynamics(scene.closed_form)
    tau = np.asarray(jax.jit(jax.vmap(known.inverse_dynamics))(q, qd, qdd))
    parts = map(np.asarray, jax.jit(jax.vmap(known.decompose))(q, qd, qdd))
    p, pd = map(np.asarray, _batched(momentum, scene)(q, qd, qdd))
    return Trajectories(t, q, qd, qdd, tau, trajectory, label, p, pd, *parts, needs=scene.needs)


def _batched(function: Callable[..., Any], scene: Scene) -> Callable[..., Any]:
    return jax.jit(jax.vmap(functools.partial(function, scene)))
