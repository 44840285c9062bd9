"""The disturbed board is the board where nothing is disturbed, and what disturbs it is what its table says."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.control import Controller, field_of, stateless
from dln_jax.mechanics.equations import dynamics
from dln_jax.scenes.pendulums import Links
from scripts.reports.control import board
from scripts.reports.control.disturbed_board import (
    APART,
    CRITERIA,
    PUSHES,
    disturbances,
    disturbed,
    last_state,
    undisturbed,
)
from scripts.reports.control.robustness import PUBLISHED

HOLDING = stateless(lambda y: -3.0 * jnp.stack([y[1] - 0.4]) - 0.2 * y[3:])
X, TAU = jnp.array([0.4, 1.1, -2.0, 3.0]), jnp.array([0.0, 1.5])


def test_without_disturbance_it_is_the_board():
    scene, B = board.plant("elbow")
    known = field_of(dynamics(scene.energies), B)(X, TAU[1:])
    np.testing.assert_allclose(disturbed("elbow", undisturbed())(X, TAU), known, rtol=1e-10)


def test_the_loop_is_that_of_the_board(monkeypatch):
    for module in ("board", "disturbed_board"):
        monkeypatch.setattr(f"scripts.reports.control.{module}.SECONDS", 0.1)
    run = board.play("elbow", HOLDING)
    ends = jax.jit(jax.vmap(lambda each: last_state("elbow", HOLDING, each, jax.random.key(0))))(
        jax.tree.map(
            lambda *each: jnp.asarray(np.stack(each)), undisturbed(), *(undisturbed()._replace(delay=n) for n in (1, 2))
        )
    )
    np.testing.assert_allclose(ends[0], run.x[-1], atol=1e-9)
    assert np.abs(ends[1] - ends[0]).max() > 1e-6 and np.abs(ends[2] - ends[1]).max() > 1e-6


@pytest.mark.parametrize(
    ("changed", "force"),
    [
        ({"viscous": np.array([0.1, 0.0])}, lambda q, qd, qdd: np.array([0.1 * qd[0], 0.0])),
        ({"dry": np.array([0.0, -0.2])}, lambda q, qd, qdd: np.array([0.0, -0.2 * np.arctan(100 * qd[1])])),
        ({"rotor": 1e-4}, lambda q, qd, qdd: 1e-4 * np.array([[37.0, -6.0], [-6.0, 36.0]]) @ qdd),
    ],
    ids=["viscous", "dry", "rotor"],
)
def test_what_is_unlike_takes_its_force(changed, force):
    q, qd = np.split(np.asarray(X), 2)
    qdd = np.asarray(disturbed("elbow", undisturbed()._replace(**changed))(X, TAU))[2:]
    known = dynamics(board.plant("elbow")[0].energies).inverse_dynamics(q, qd, qdd)
    np.testing.assert_allclose(np.asarray(known) + force(q, qd, qdd), TAU, atol=1e-9)


def test_the_table_is_the_boards():
    table = disturbances()
    assert {name: len(listed) for name, listed in table.items()} == dict(
        zip(CRITERIA, (210, 210, 210, 21, 21, 50), strict=True)
    )
    # One thing is unlike at a time, and the middle one of masses and inertias is not.
    assert sum(each.links == Links() and each.rotor == 0 and not np.any(each.viscous) for each in table["model"]) > 5
    for each in table["pushes"]:
        times = np.sort(each.times.ravel())
        assert times[0] >= APART and (np.diff(times) >= APART).all() and times[-1] <= 10 - APART
        assert (np.abs(each.pushes) >= PUSHES[0]).all() and (np.abs(each.pushes) <= PUSHES[1]).all()


@pytest.mark.parametrize(("motor", "driven"), [("shoulder", 0), ("elbow", 1)])
def test_only_pushes_on_the_driven_joint_move_the_arm(monkeypatch, motor, driven):
    monkeypatch.setattr("scripts.reports.control.disturbed_board.SECONDS", 0.2)
    idle = stateless(lambda y: jnp.zeros(1))
    pushes, middle = 3.0 * np.eye(2)[:, :, None], np.full((2, 1), 0.1)
    of_each = undisturbed()._replace(times=middle, widths=np.full((2, 1), 0.02))
    ends = [
        np.asarray(jax.jit(lambda each=each: last_state(motor, idle, each, jax.random.key(0)))())
        for each in (of_each._replace(pushes=push) for push in pushes)
    ]
    assert np.abs(ends[driven]).max() > 0.1
    np.testing.assert_array_equal(ends[1 - driven], 0.0)


def test_printed_means_are_those_of_printed_shares():
    for table in PUBLISHED.values():
        for name, (*each, mean) in table.items():
            assert np.mean(each) / 100 == pytest.approx(mean, abs=6e-4), name


def test_a_controller_that_fails_has_no_last_state():
    failing = Controller(jnp.asarray(0), lambda n, t, y: (n + 1, jnp.where(n == 3, jnp.nan, 0.0)[None]))
    run = jax.jit(lambda: last_state("elbow", failing, undisturbed(), jax.random.key(0)))
    assert np.isnan(run()).any()
