"""Random arms, their logs, and faults in logs, to test the verdict on identified robots."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from dln_jax.data.robots import Robot
from dln_jax.mechanics.trees import dh_frames, inertial_parameters, serial
from dln_jax.precision import in_float64
from scripts.reports.robots.simulated_arms import Arm, arm_torques

Arrays = dict[str, Any]
TRAJECTORIES, SECONDS, RATE = 5, 8.0, 100.0
TURNS = (0.0, -np.pi / 2, np.pi / 2, 0.0, 0.6)
"""Angles between successive axes of random arms, rad; 0 gives a planar arm."""


class Fault(NamedTuple):
    """A change of a sound log's arrays, and the verdict it must lead to."""

    spoil: Callable[[Arrays, np.random.Generator], Arrays]
    level: str
    """"refused", or "doubtful" if that suffices."""


def random_arm(seed: int, d: int) -> Arm:
    """A serial arm of d revolute joints, planar or spatial, with physically consistent inertias and friction."""
    random = np.random.default_rng([seed, d, 0])
    turns = np.zeros(d) if random.random() < 0.3 else random.choice(TURNS, d)
    turns[0] = np.pi / 2 if not turns.any() else turns[0]
    rows = np.column_stack([turns, random.uniform(0.1, 0.4, d), random.uniform(0.0, 0.3, d), random.uniform(-1, 1, d)])
    bodies = [_body(3.0 * 0.75**link * random.uniform(0.7, 1.4), random) for link in range(d)]
    size = 0.8 ** np.arange(d)
    return Arm(
        f"arm-{d}-{seed}",
        serial(*dh_frames(rows), bodies, armature=0.1 * size * random.uniform(0.3, 1, d)),
        viscous=0.4 * size * random.uniform(0.2, 1, d),
        coulomb=0.5 * size * random.uniform(0.2, 1, d),
        offset=0.1 * size * random.normal(size=d),
        limits=np.tile([-2.5, 2.5], (d, 1)),
        rates=np.full(d, 2.5),
        accelerations=np.full(d, 12.0),
    )


def rough_file(arm: Arm, seed: int) -> Robot:
    """The arm as in an unmeasured file: masses wrong by about a third, no armature, no friction."""
    factors = np.exp(np.random.default_rng([seed, 1]).normal(0.0, 0.3, (len(arm.tree.inertias), 1)))
    tree = arm.tree._replace(inertias=np.asarray(arm.tree.inertias) * factors, armature=np.zeros(len(factors)))
    none = np.zeros(len(factors))
    return Robot(tree, none, none, arm.limits, np.tile([-np.inf, np.inf], (len(factors), 1)))


@in_float64
def sound_log(arm: Arm, seed: int, noise: float) -> Arrays:
    """Motions of five sines per joint; torques have white noise, `noise` times their standard deviation."""
    random, d = np.random.default_rng([seed, 2]), len(arm.rates)
    t = np.arange(0.0, SECONDS, 1 / RATE)
    states = []
    for _ in range(TRAJECTORIES):
        w = 2 * np.pi * random.uniform(0.1, 1.0, (5, d))
        a, phase = random.uniform(0.2, 0.8, (5, d)) / (1 + w), random.uniform(0, 2 * np.pi, (5, d))
        angle = w * t[:, None, None] + phase
        states.append(
            [np.sum(x, axis=1) for x in (a * np.sin(angle), a * w * np.cos(angle), -a * w**2 * np.sin(angle))]
        )
    q, qd, qdd = (np.concatenate(each) for each in zip(*states, strict=True))
    tau = arm_torques(arm, q, qd, qdd, friction=True)
    tau = tau + noise * tau.std(axis=0) * random.normal(size=tau.shape)
    return {
        "t": np.tile(t, TRAJECTORIES), "q": q, "qd": qd, "qdd": qdd, "tau": tau,
        "trajectory": np.repeat(np.arange(TRAJECTORIES), len(t)),
    }  # fmt: skip


def _flipped(log: Arrays, random: np.random.Generator) -> Arrays:
    joint = random.integers(log["tau"].shape[1])
    return {**log, "tau": np.where(np.arange(log["tau"].shape[1]) == joint, -1, 1) * log["tau"]}


def _spikes(log: Arrays, random: np.random.Generator) -> Arrays:
    hit = random.random(log["tau"].shape) < 0.01
    return {**log, "tau": log["tau"] + hit * random.choice([-20, 20], hit.shape) * log["tau"].std(axis=0)}


def _delayed(log: Arrays, random: np.random.Generator) -> Arrays:
    return {**log, "tau": np.roll(log["tau"], int(0.2 * RATE), axis=0)}


def _shuffled(log: Arrays, random: np.random.Generator) -> Arrays:
    return {**log, "tau": np.roll(log["tau"], len(log["t"]) // 3, axis=0)}


def _dead(log: Arrays, random: np.random.Generator) -> Arrays:
    joint = random.integers(log["tau"].shape[1])
    return {**log, "tau": np.where(np.arange(log["tau"].shape[1]) == joint, 0.0, log["tau"])}


FAULTS: dict[str, Fault] = {
    "flipped-sign": Fault(_flipped, "refused"),
    "all-signs-flipped": Fault(lambda log, random: {**log, "tau": -log["tau"]}, "refused"),
    "swapped-columns": Fault(lambda log, random: {**log, "tau": log["tau"][:, ::-1]}, "refused"),
    "millinewton-metres": Fault(lambda log, random: {**log, "tau": 1e3 * log["tau"]}, "refused"),
    "rates-exchanged": Fault(lambda log, random: {**log, "qd": log["qdd"], "qdd": log["qd"]}, "doubtful"),
    "torques-of-another-motion": Fault(_shuffled, "refused"),
    "degrees": Fault(
        lambda log, random: {**log, **{key: np.degrees(log[key]) for key in ("q", "qd", "qdd")}}, "refused"
    ),
    "spikes": Fault(_spikes, "doubtful"),
    "late-by-200-ms": Fault(_delayed, "doubtful"),
    "dead-channel": Fault(_dead, "doubtful"),
}
"""Faults by name. Spikes are torques of 20 standard deviations in 1 of 100 samples."""


def _body(mass: float, random: np.random.Generator) -> np.ndarray:
    """Six points of equal mass."""
    points = random.uniform(-0.1, 0.1, (6, 3)) + random.uniform(-0.1, 0.2, 3)
    away = points - points.mean(axis=0)
    about = mass / 6 * (np.sum(away**2) * np.eye(3) - away.T @ away)
    return np.asarray(inertial_parameters(mass, points.mean(axis=0), about))
