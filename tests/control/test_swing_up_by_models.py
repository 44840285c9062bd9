"""A swing-up takes any model that it can use, and says in one line why it cannot use another."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.control.closed_loop import hanging_starts, outcomes
from dln_jax.control.desktop_plants import desktop_plant, law_of, model_of_plant, nominal_model, try_starts
from dln_jax.control.swing_up import nearest_equilibrium, swing_up
from dln_jax.mechanics.dynamics import PlainDynamics
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.types import InputError

PLANT = desktop_plant("rotary-pendulum")
NOMINAL = nominal_model(PLANT)
ANGLES = np.stack([np.zeros(9), np.linspace(-np.pi, np.pi, 9)], axis=1)


def with_potential(extra):
    """the nominal model with another energy added."""
    L = PLANT.nominal(**PLANT.sizes).lagrangian
    return dynamics(LagrangianSystem(lambda q, qd: L(q, qd) - extra(q)))


@pytest.mark.slow
def test_dry_friction_holds_no_pole_down():
    tried = try_starts(PLANT, model_of_plant(PLANT), starts=8, seed=5, seconds=3.0)
    assert tried.outcomes.share == 1 and tried.outcomes.worst < 3.0
    # Exactly at rest, where the energy law asks for nothing.
    law = jax.jit(law_of(PLANT, NOMINAL).law)
    assert float(jnp.abs(law(jnp.array([0.0, np.pi, 0.0, 0.0]))[0])) == pytest.approx(PLANT.numbers.kick)


@pytest.mark.slow
def test_a_state_that_is_no_number_has_no_control():
    law = jax.jit(law_of(PLANT, NOMINAL).law)
    for place in range(4):
        assert not np.isfinite(law(jnp.array([0.1, 3.0, 0.2, 0.3]).at[place].set(jnp.nan))).any()


def test_the_model_s_own_equilibrium_is_found():
    tilted = with_potential(lambda q: 1e-3 * q[1])
    weight = PLANT.sizes["pole_mass"] * 9.81 * PLANT.sizes["pole_length"] / 2
    home = nearest_equilibrium(tilted, np.zeros(2), (1,))
    np.testing.assert_allclose(home, [0.0, np.arcsin(1e-3 / weight)], atol=1e-10)


def build(model, **changed):
    lab = PLANT.hardware
    keywords = {"postures": ANGLES, "lower": lab.lower, "upper": lab.upper, **changed}
    needs = PLANT.scene.needs
    return swing_up(model, needs.actuation, needs.joints, np.zeros(2), PLANT.numbers, **keywords)


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (PlainDynamics(NOMINAL.inverse_dynamics, NOMINAL.forward_dynamics, NOMINAL.decompose), "has no energy"),
        (dynamics(LagrangianSystem(lambda q, qd: 0.5 * qd[0] ** 2 - 0.5 * qd[1] ** 2)), "not positive definite"),
        (with_potential(lambda q: 0.1 * q[1]), "no equilibrium near the goal"),
        (with_potential(lambda q: 0.2 * q[0]), "do not hold the goal"),
    ],
    ids=["no-energy", "indefinite", "no-equilibrium", "weak-motor"],
)
def test_a_model_that_cannot_be_used_is_one_line(model, message):
    with pytest.raises(InputError, match=message):
        build(model)


def test_runs_that_are_no_number_are_failures_and_counted():
    angle = np.array([[3.1, 0.2, 0.05, 0.05], [3.1, 0.05, np.nan, np.nan], [0.0, 0.0, 0.0, 0.0], [3.1, 0.0, 0.0, 0.3]])
    found = outcomes(angle, rate=10.0)
    np.testing.assert_allclose(found.seconds, [0.2, np.inf, 0.0, np.inf])
    np.testing.assert_array_equal(found.failed, [False, True, False, False])
    assert found.share == 0.5 and found.worst == 0.2
    assert outcomes(angle + 2 * np.pi, rate=10.0).share == 0.5


def test_starts_hang_at_rest_all_but():
    x = hanging_starts(500, 0, position=0.02)
    assert (x[:, 2:] == 0).all() and x[:, 0].std() == pytest.approx(0.02, rel=0.1)
    assert (x[:, 1] - np.pi).std() == pytest.approx(0.1, rel=0.1)
