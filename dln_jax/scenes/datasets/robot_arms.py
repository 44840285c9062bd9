"""Sum-of-sines motions of robot arms and their torques: the protocol of the LIP paper.

Giacomuzzo, Carli, Romeres and Dalla Libera, T-RO 2024 (arXiv 2310.06585; merlresearch/LIP4RobotInverseDynamics): 50 s,
torque noise of 0.01 N m, seed 0 for training and 101 to 150 for the test; every tenth of 5,001 samples is fitted.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from dln_jax.data.schema import Trajectories
from dln_jax.mechanics.trees.recursions import newton_euler
from dln_jax.precision import in_float64
from dln_jax.scenes.robot_arms import Arm
from dln_jax.types import InputError, require_positive, require_seed

SINES = 50
TRIES = 10
"""Draws of a joint's motion after which amplitudes are reduced."""


class Motion(NamedTuple):
    """Motion of an arm at equal steps of time."""

    t: Float[np.ndarray, " N"]
    q: Float[np.ndarray, "N d"]
    qd: Float[np.ndarray, "N d"]
    qdd: Float[np.ndarray, "N d"]


def sum_of_sines(arm: Arm, *, seed: int, duration: float = 50.0, dt: float = 0.01, span: float = 0.5) -> Motion:
    """qd = sum over k = 1 .. 50 of a_k cos(k w t) + b_k sin(k w t), drawn joint by joint, w = 2 pi / 50 s.

    a_k and b_k are uniform in ±0.1 r per second, with r the `span` of half a joint's limits. A draw that leaves
    q_middle ± r, or is too fast, is repeated; after every ten tries the range shrinks by a factor 0.8.

    Args:
        arm: arm whose limits apply.
        seed: seed of the draws.
        duration: s; both ends are samples.
        dt: s.
        span: fraction of the limits, in (0, 1].

    Raises:
        InputError: a setting out of range.
    """
    require_positive(duration=duration, dt=dt, span=span)
    require_seed(seed)
    if span > 1:
        raise InputError(f"span is {span}; expected a share of the joints' limits, at most 1")
    t = dt * np.arange(round(duration / dt) + 1)
    w = 2 * np.pi * 0.02 * np.arange(1, SINES + 1)
    cosines, sines = np.cos(np.outer(t, w)), np.sin(np.outer(t, w))
    random = np.random.default_rng(seed)
    joints = []
    for limits, rate, acceleration in zip(arm.limits, arm.rates, arm.accelerations, strict=True):
        reach = span * np.ptp(limits) / 2
        tries, size = 0, 0.1 * reach
        while True:
            a, b = size * random.uniform(-1, 1, (2, SINES))
            q, qd, qdd = (
                sines @ (a / w) - cosines @ (b / w),
                cosines @ a + sines @ b,
                cosines @ (b * w) - sines @ (a * w),
            )
            if abs(q).max() < reach and abs(qd).max() < rate and abs(qdd).max() < acceleration:
                break
            tries += 1
            if tries % TRIES == 0:
                size *= 0.8
        joints.append((q + limits.mean(), qd, qdd))
    q, qd, qdd = np.array(joints).transpose(1, 2, 0)
    return Motion(t, q, qd, qdd)


@in_float64
def arm_torques(arm: Arm, q: Any, qd: Any, qdd: Any, *, friction: bool) -> Float[np.ndarray, "N d"]:
    """Noiseless tau of states [N, d]; dry friction has the sign of the rate."""
    tau = np.asarray(jax.jit(jax.vmap(lambda *state: newton_euler(arm.tree, *state)))(q, qd, qdd))
    return tau + arm.viscous * qd + arm.coulomb * np.sign(qd) + arm.offset if friction else tau


def lip_trajectories(
    arm: Arm,
    seeds: Sequence[int] = (0,),
    *,
    friction: bool = False,
    noise: float = 0.01,
    every: int = 10,
    duration: float = 50.0,
    span: float = 0.5,
) -> Trajectories:
    """One trajectory per seed from `sum_of_sines`, subsampled.

    Args:
        arm: the arm.
        seeds: seeds of the motions and their noise.
        friction: whether the arm's friction acts.
        noise: standard deviation of the torques' noise, N m or N; drawn for all samples, also those not kept.
        every: keep every `every`-th sample (10 ms apart).
        duration: s.
        span: fraction of the joints' limits that the motions use.

    Raises:
        InputError: no seeds, or a setting out of range.
    """
    require_positive(every=every)
    if not len(seeds):
        raise InputError("seeds is empty; expected one for each trajectory")
    parts = []
    for seed in seeds:
        motion = sum_of_sines(arm, seed=seed, duration=duration, span=span)
        errors = noise * np.random.default_rng([seed, 1]).normal(size=motion.q.shape)
        parts.append([each[::every] for each in (*motion, errors)])
    t, q, qd, qdd, errors = (np.concatenate(each) for each in zip(*parts, strict=True))
    return Trajectories(
        t=t,
        q=q,
        qd=qd,
        qdd=qdd,
        tau=arm_torques(arm, q, qd, qdd, friction=friction) + errors,
        trajectory=np.repeat(np.arange(len(seeds)), [len(part[0]) for part in parts]),
        label=np.array([f"seed-{seed}" for seed in seeds]),
        needs=arm.tree.needs._replace(friction=friction),
    )
