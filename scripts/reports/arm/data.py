"""Data of the two-link arm: letters and random states, their splits, the published free swings, and errors on them."""

import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from dln_jax.data import schema
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import Split, select, split
from dln_jax.mechanics.dynamics import Dynamics, InverseForward
from dln_jax.mechanics.equations import Driven
from dln_jax.mechanics.integrators import rollout, symplectic_euler
from dln_jax.metrics.errors import as_arrays, prediction_program, samples_of
from dln_jax.metrics.motions import metrics_of_motions, motion_program, records_of
from dln_jax.precision import in_float64
from dln_jax.scenes.datasets import generators
from dln_jax.scenes.datasets.generators import CHARACTERS_TEST
from dln_jax.scenes.pendulums import two_link_arm
from dln_jax.scenes.scene import closed_form_forward_dynamics
from dln_jax.types import Hamiltonian, InputError

STARTS = np.array([[np.pi / 4, np.pi / 4], [-np.pi, -np.pi / 2], [-np.pi / 4, np.pi / 2]])
"""Postures at rest of the published test, rad: q2 is relative to link 1, zero is horizontal."""
HELD_OUT = 300
"""Random states that select among iterates."""


@functools.cache
def letters(path: Path | None = None) -> Trajectories:
    """The letters of the arm, embedded or from a file."""
    data = generators.default_data(two_link_arm()) if path is None else schema.load(path)
    if data.degrees_of_freedom != 2:
        raise InputError(f"{path} has {data.degrees_of_freedom} coordinates; the report is that of the two-link arm")
    return data._replace(needs=two_link_arm().needs)


@functools.cache
def published_split(path: Path | None = None, seed: int = 0) -> Split:
    """The letters with the published ones as the test."""
    return split(letters(path), test=CHARACTERS_TEST, seed=seed)


@functools.cache
def random_states() -> Split:
    """Random states of the arm for training, and the published free swings for the test."""
    data = generators.uniform(two_link_arm())._replace(needs=two_link_arm().needs)
    permuted = np.random.default_rng(0).permutation(len(data.t))
    return Split(select(data, permuted[HELD_OUT:]), select(data, permuted[:HELD_OUT]), published_swings())


def whole_circle() -> Trajectories:
    """Random states over the whole circle, most of them far from all letters, with the letters' rates in 1/s."""
    bounds = {"position_bound": np.pi, "rate_bound": 2.0, "acceleration_bound": 8.0}
    return generators.uniform(two_link_arm(), samples=1_000, seed=1, **bounds)


def partition_labels(data: Trajectories, parts: int, *, seed: int = 0) -> list[list[str]]:
    """Labels in groups of nearly equal size for cross-validation: every trajectory is in one test.

    Raises:
        InputError: fewer than two parts, or more than there are trajectories.
    """
    labels = np.sort(data.label[np.unique(data.trajectory)])
    if not 2 <= parts <= len(labels):
        raise InputError(f"{len(labels)} trajectories cannot be cut into {parts} tests; ask for 2 to {len(labels)}")
    permuted = np.random.default_rng(seed).permutation(labels)
    return [part.tolist() for part in np.array_split(permuted, parts)]


@in_float64
def published_swings() -> Trajectories:
    """The published test motions of the two-link arm (Lutter et al. 2019, the `uniform` experiment), from `STARTS`.

    Three free swings from rest, 400 samples at 0.02 s, by symplectic Euler at 2 ms. The integrator is part of the data:
    an accurate rollout of the true plant departs from these motions after some seconds (valid prediction time 6.47 s).
    """
    scene, t = two_link_arm(), 0.02 * np.arange(400)
    step = symplectic_euler(
        velocity=lambda t, q, qd: qd,
        force=lambda t, q, qd: closed_form_forward_dynamics(scene, q, qd, jnp.zeros_like(q)),
    )
    motion = jax.jit(jax.vmap(lambda q, qd: rollout(step, (q, qd), jnp.asarray(t), substeps=10)))
    return generators.swings(scene, t, *map(np.asarray, motion(STARTS, np.zeros_like(STARTS))))


def predictions(
    system: Driven, data: Trajectories, dtype: DTypeLike, *, H: Hamiltonian | None = None
) -> dict[str, np.ndarray]:
    """Returns predictions of a system for every sample, in float64; `H` as for `prediction_program`."""
    program = jax.jit(prediction_program(lambda _: system, H=H))
    return as_arrays(program(None, samples_of(data, dtype)))


def rollout_metrics(
    dynamics: Dynamics | InverseForward, data: Trajectories, *, dtype: DTypeLike | None = None
) -> dict[str, float]:
    """Returns `metrics_of_motions` of a system's predictions from its first states and torques.

    Raises InputError for a trajectory of a single sample, or a coordinate that never changes.
    """
    motions, energies = jax.jit(motion_program(lambda _: dynamics))(None, records_of(data, dtype))
    return metrics_of_motions(motions, energies, data)
