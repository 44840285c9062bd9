"""With the linear parameters eliminated, slopes are those of finite differences, and gauges change nothing."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.learning.kinematics.frames import Frames, displace, free_directions, random_frames
from dln_jax.learning.kinematics.projection import Structure, design, project
from dln_jax.mechanics.trees.description import make_tree
from dln_jax.mechanics.trees.recursions import newton_euler

KINDS = ("revolute", "prismatic", "revolute")
STRUCTURE = Structure((-1, 0, 1), KINDS, 9.81, True, 0.1)
UNIT = jnp.array([2.0, 3.0, 0.5])


@functools.cache
def problem():
    random = np.random.default_rng(0)
    frames = random_frames(3, random)
    state = random.normal(size=(3, 40, 3))
    linear = random.normal(size=STRUCTURE.linear_count)
    frames = Frames(*map(jnp.asarray, frames))
    return frames, (*state, np.asarray(columns(frames, *state)) @ linear), linear


@jax.jit
def columns(frames, q, qd, qdd):
    return jax.vmap(functools.partial(design, STRUCTURE, frames))(q, qd, qdd)


def projected(step, further=None):
    """At frames some steps from the true ones."""
    frames, samples, _ = problem()
    return projected_from(frames, samples, step, further)


@jax.jit
def projected_from(frames, samples, step, further):
    for each in (step, further):
        frames = frames if each is None else displace(frames, each.reshape(3, 6))
    return project(STRUCTURE, frames, samples, UNIT, ridge=1e-12)


def test_the_design_has_all_that_a_tree_shows():
    frames, samples, _ = problem()
    tree = make_tree(STRUCTURE.parents, KINDS, *frames, np.tile([0, 0, 1], (3, 1)), np.ones((3, 10)))
    tau = np.asarray(jax.jit(jax.vmap(functools.partial(newton_euler, tree)))(*samples[:3]))
    Phi = np.asarray(columns(frames, *samples[:3]))
    flat = Phi.reshape(-1, Phi.shape[-1])
    # Whatever bodies hang on it, the minimal columns explain their torques.
    solution, *_ = np.linalg.lstsq(flat, tau.ravel(), rcond=1e-12)
    np.testing.assert_allclose(flat @ solution, tau.ravel(), atol=1e-9)


def test_slopes_are_those_of_finite_differences():
    places = free_directions(STRUCTURE.parents, KINDS)
    samples = problem()[1][-1].size
    start = jnp.zeros(18).at[places].set(0.1 * np.random.default_rng(1).normal(size=len(places)))
    at = projected(start)
    for place, slope in zip(places, at.slope, strict=True):
        step = jnp.zeros(18).at[place].set(1e-5)
        higher, lower = (projected(start, sign * step).loss for sign in (1, -1))
        np.testing.assert_allclose(-slope, (higher - lower) / 4e-5 * samples, rtol=1e-4, atol=1e-4)


def test_near_the_solution_kaufmans_matrix_is_the_curvature():
    at = projected(jnp.zeros(18))
    places = free_directions(STRUCTURE.parents, KINDS)
    direction = np.random.default_rng(2).normal(size=len(places))
    step = 1e-4 * jnp.zeros(18).at[places].set(direction)
    predicted = 1e-8 * direction @ at.normal @ direction
    assert float(projected(step).loss) * problem()[1][-1].size == pytest.approx(float(predicted), rel=1e-2)


def test_gauges_change_nothing():
    # Where the base stands, and how the last link's frame is turned about its axis and moved along it.
    for place in (3, 4, 5, 14, 17):
        assert projected(jnp.zeros(18).at[place].set(0.1)).loss < 1e-14, place
