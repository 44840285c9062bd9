"""Data sets sampled from scenes, with exact rates, torques and decomposition, in float64."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dln_jax.data.schema import Trajectories
from dln_jax.datasets.letters import LETTERS, letter_path
from dln_jax.mechanics import lagrangian
from dln_jax.mechanics.integrators import adaptive_rollout, second_order
from dln_jax.precision import in_float64
from dln_jax.scenes.scene import (
    Scene,
    actuation_matrix,
    closed_form_decomposition,
    closed_form_forward_dynamics,
    closed_form_inverse_dynamics,
)
from dln_jax.scenes.two_link_arm import joint_angles, two_link_arm
from dln_jax.types import InputError, require_positive


@in_float64
def characters(*, letters: Sequence[str] = LETTERS, dt: float = 0.04) -> Trajectories:
    """The two-link arm's tip writes letters, one trajectory each, sampled every `dt` s.

    The outlines come from matplotlib's bundled font, smoothed; angles, rates and torques are exact derivatives of
    the tip's path through the inverse kinematics and the closed-form equations of motion.
    """
    require_positive(dt=dt)
    _require_finite(dt=dt)
    paths = [letter_path(letter) for letter in letters]
    times = [np.arange(0.0, path.duration, dt) for path in paths]

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

    # One length for all, so that letters share a compilation; a path rests beyond its end.
    longest = max(map(len, times))
    motions = [states(path.position, dt * np.arange(longest)) for path in paths]
    q, qd, qdd = (
        np.concatenate([np.asarray(motion[k])[: len(t)] for motion, t in zip(motions, times, strict=True)])
        for k in range(3)
    )
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
    """Independent random states, each a trajectory of its own, uniform in a box symmetric about zero.

    Bounds are in rad or m, 1/s, 1/s² and N m or N. A fully actuated scene draws accelerations; an under-actuated one
    draws controls, from which the accelerations follow.
    """
    bounds = {
        "position_bound": position_bound,
        "rate_bound": rate_bound,
        "acceleration_bound": acceleration_bound,
        "control_bound": control_bound,
    }
    require_positive(samples=samples, **bounds)
    _require_finite(**bounds)
    _require_seed(seed)
    d = scene.needs.degrees_of_freedom
    random = np.random.default_rng(seed)
    q, qd = (random.uniform(-bound, bound, (samples, d)) for bound in (position_bound, rate_bound))
    if scene.needs.actuation is None:
        qdd = random.uniform(-acceleration_bound, acceleration_bound, (samples, d))
    else:
        matrix = actuation_matrix(scene.needs)
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
    """Motions from rest without torque, integrated adaptively (Dormand-Prince 8) to the given tolerance.

    Without `starts` [K, d], as many starting postures as asked for are drawn within ±π/2 (rad, or m).

    Raises:
        InputError: the integration does not finish.
    """
    require_positive(trajectories=trajectories, steps=steps, dt=dt, tolerance=tolerance)
    _require_finite(dt=dt)
    _require_seed(seed)
    d = scene.needs.degrees_of_freedom
    if starts is None:
        starts = np.random.default_rng(seed).uniform(-np.pi / 2, np.pi / 2, (trajectories, d))
    t = dt * np.arange(steps)
    q, qd = rollouts(scene, starts, np.zeros_like(starts), t, tolerance=tolerance)
    q, qd = q.reshape(-1, d), qd.reshape(-1, d)
    qdd = np.asarray(_batched(closed_form_forward_dynamics, scene)(q, qd, np.zeros_like(q)))
    trajectory = np.repeat(np.arange(len(starts)), steps)
    label = np.array([f"swing-{index}" for index in range(len(starts))])
    data = completed(scene, np.tile(t, len(starts)), q, qd, qdd, trajectory, label)
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
    """Reference motions of a scene without torque from K states: q and qd at the times t, which start at 0."""

    def acceleration(time, q, qd):
        return closed_form_forward_dynamics(scene, q, qd, jnp.zeros_like(q))

    @jax.jit
    @jax.vmap
    def solve(q, qd):
        return adaptive_rollout(second_order(acceleration), (q, qd), jnp.asarray(t), tolerance=tolerance)

    motions, successful = solve(q, qd)
    if not bool(successful.all()):
        raise InputError(f"the motion could not be integrated to {tolerance:g}; ask for less accuracy or time")
    return np.asarray(motions[0]), np.asarray(motions[1])


def completed(scene: Scene, t, q, qd, qdd, trajectory, label) -> Trajectories:
    """Adds exact torques, momenta and the decomposition to a motion of a scene; arrays as in the schema."""
    parts = _batched(closed_form_decomposition, scene)(q, qd, qdd)

    def momentum(scene, q, qd, qdd):
        p, pd = jax.jvp(lambda q, qd: lagrangian.momentum(scene.lagrangian, q, qd), (q, qd), (qd, qdd))
        return p, pd

    p, pd = _batched(momentum, scene)(q, qd, qdd)
    return Trajectories(
        t=t,
        q=q,
        qd=qd,
        qdd=qdd,
        tau=np.asarray(_batched(closed_form_inverse_dynamics, scene)(q, qd, qdd)),
        trajectory=trajectory,
        label=label,
        p=np.asarray(p),
        pd=np.asarray(pd),
        tau_inertial=np.asarray(parts.inertial),
        tau_coriolis=np.asarray(parts.coriolis),
        tau_gravity=np.asarray(parts.gravity),
        needs=scene.needs,
    )


def _require_finite(**numbers: float) -> None:
    for name, value in numbers.items():
        if not np.isfinite(value):
            raise InputError(f"{name} is {value}; expected a finite number")


def _require_seed(seed: int) -> None:
    if seed < 0:
        raise InputError(f"seed is {seed}; expected 0 or a positive integer")


def _batched(function, scene: Scene):
    return jax.jit(jax.vmap(lambda *state: function(scene, *state)))
