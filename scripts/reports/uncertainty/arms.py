"""Arms with known frames and noisy motions: torques of rigid bodies, friction, and effects that our models lack."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.compilation import quick_compilation
from dln_jax.data.schema import Trajectories, from_arrays
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction import joint_dissipation
from dln_jax.mechanics.trees import Tree, inertial_parameters, serial, tree_system
from dln_jax.types import Vector
from scripts.reports.robots.simulated_arms import panda

VELOCITY_SCALE = 0.05
"""Velocity scale of dry friction, rad/s."""
SECONDS, STEP = 6.0, 0.04
"""Length of a motion, and time between its samples."""

Plant = Callable[..., Any]


def arm(d: int) -> Tree:
    """The first d joints of a Panda, with links that get lighter, and motors."""
    random = np.random.default_rng(0)
    links = [
        inertial_parameters(5.0 / (1 + i / 2), 0.1 * random.normal(size=3), 0.03 * np.diag(random.uniform(0.5, 1.5, 3)))
        for i in range(d)
    ]
    frames = panda().tree
    return serial(frames.rotations[:d], frames.positions[:d], links, armature=np.full(d, 0.05))


def plant(tree: Tree, *, unmodelled: bool) -> Plant:
    """(q, qd, qdd) [N, d] each -> torques [N, d] of the arm with viscous and dry friction.

    With `unmodelled`, also friction that grows with the weight on a joint and as it slows down (Stribeck).
    """
    d = tree.degrees_of_freedom
    friction = joint_dissipation(
        np.full(d, 0.2), np.full(d, 0.5), np.linspace(-0.1, 0.1, d), velocity_scale=VELOCITY_SCALE
    )
    motion = dynamics(tree_system(tree, friction))

    def torque(q: Vector, qd: Vector, qdd: Vector) -> Vector:
        tau = motion.inverse_dynamics(q, qd, qdd)
        if not unmodelled:
            return tau
        weight = motion.decompose(q, 0 * q, 0 * q).gravity
        return tau + jnp.tanh(qd / VELOCITY_SCALE) * (0.3 * jnp.exp(-((qd / 0.3) ** 2)) + 0.03 * jnp.abs(weight))

    return jax.jit(jax.vmap(torque), compiler_options=quick_compilation())


def motions(
    torque: Plant, d: int, count: int, *, noise: float, seed: int, reach: float = 1.0, speed: float = 1.0
) -> Trajectories:
    """Motions of four sines per joint with drawn amplitudes, frequencies and phases.

    Args:
        torque: torques of a `plant`.
        d: number of its joints.
        count: number of motions.
        noise: standard deviation of the first torque's noise, N m; it falls to 30 % of that at the last joint.
        seed: seed of everything drawn.
        reach: factor on amplitudes.
        speed: factor on frequencies.
    """
    random, t = np.random.default_rng(seed), np.arange(0, SECONDS, STEP)
    rate = speed * 2 * np.pi * random.uniform(0.05, 0.5, (count, 1, d, 4))
    size = reach * random.uniform(0.1, 0.5, (count, 1, d, 4))
    phase = rate * t[:, None, None] + random.uniform(0, 2 * np.pi, (count, 1, d, 4))
    middle = random.uniform(-0.3, 0.3, (count, 1, d))
    q = middle + np.sum(size * np.sin(phase), axis=-1)
    qd, qdd = np.sum(size * rate * np.cos(phase), axis=-1), -np.sum(size * rate**2 * np.sin(phase), axis=-1)
    q, qd, qdd = (array.reshape(-1, d) for array in (q, qd, qdd))
    tau = np.asarray(torque(q, qd, qdd))
    tau = tau + noise * np.linspace(1, 0.3, d) * random.normal(size=tau.shape)
    trajectory = np.repeat(np.arange(count), len(t))
    return from_arrays({"t": np.tile(t, count), "q": q, "qd": qd, "qdd": qdd, "tau": tau, "trajectory": trajectory})
