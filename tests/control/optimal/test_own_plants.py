"""The problem of one's own plant has the plant's scales, and its iterations go on as if they had never stopped."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.control.optimal.action_costs import limited_atan, stretched
from dln_jax.control.optimal.fitted import Iteration, fit_values
from dln_jax.control.optimal.own_plants import OwnProblem, own_plant, own_problem, own_settings
from dln_jax.control.optimal.plants import evaluate, starts
from dln_jax.control.optimal.value_networks import value_network
from dln_jax.control.plants import layout
from dln_jax.mechanics import closed_form
from dln_jax.mechanics.equations import dynamics
from dln_jax.scenes.poles import cart_pole
from dln_jax.types import InputError


def rod(length=1.0):
    """A driven rod of 1 kg."""
    return closed_form.dynamics(
        closed_form.ClosedForm(
            lambda q: jnp.full((1, 1), length**2 / 3, q.dtype),
            lambda q, qd: jnp.zeros_like(q),
            lambda q: 9.81 * length / 2 * jnp.cos(q[0]),
            lambda q: -9.81 * length / 2 * jnp.sin(q),
        )
    )


def of_rod(length=1.0, control=2.5, **options):
    plant = layout(
        ["revolute"], [0], goal=[0.0], hanging=[np.pi], rate=100.0, control=control, passive=False, **options
    )  # fmt: skip
    return own_problem(rod(length), plant)


POLE = cart_pole(cart_mass=0.57, pole_mass=0.127, length=0.16825)
RAIL = layout(
    ["prismatic", "revolute"], [0], goal=[0.0, 0.0], hanging=[0.0, np.pi], rate=100.0, control=12.0,
    position=[[-0.5, 0.3], [-np.inf, np.inf]],
)  # fmt: skip


def test_a_rod_falls_at_the_rate_of_its_closed_form_and_a_longer_one_takes_longer():
    short, long = of_rod(), of_rod(4.0, 10.0)
    assert short.scale == pytest.approx(np.sqrt(1.5 * 9.81), rel=1e-9)
    assert long.scale == pytest.approx(short.scale / 2, rel=1e-9)
    numbers, slower = own_settings(short).numbers, own_settings(long).numbers
    np.testing.assert_allclose(
        [slower.dt, slower.seconds, slower.memory], 2 * np.array([numbers.dt, numbers.seconds, numbers.memory])
    )
    assert own_plant(rod(4.0), long).problem.discount == pytest.approx(own_plant(rod(), short).problem.discount / 2)


def test_hanging_costs_pi_squared_and_half_of_the_limits_a_share_of_it():
    plant = own_plant(rod(), of_rod())
    cost = plant.problem.state_cost(jnp.array([np.pi, 0.0]))
    assert float(cost) == pytest.approx(0.5 * np.pi**2)  # driven
    assert float(plant.problem.action_cost.cost(jnp.array([1.25]))) == pytest.approx(0.25 * np.pi**2)


def test_strong_motors_set_the_pace_where_nothing_falls():
    assert of_rod(control=1e4).scale == pytest.approx(np.sqrt(3e4 / np.pi))


def test_the_field_is_that_of_the_plant_and_barriers_rise_at_the_ends_of_the_rail():
    model = dynamics(POLE.closed_form)
    numbers = own_problem(model, RAIL)
    problem = own_plant(model, numbers).problem
    x, u = jnp.array([0.1, 0.7, -0.4, 2.0]), jnp.array([3.0])
    expected = model.forward_dynamics(x[:2], x[2:], jnp.array([3.0, 0.0]))
    np.testing.assert_allclose((problem.drift(x) + problem.actuation(x) @ u)[2:], expected, rtol=1e-12)
    ends = np.array([problem.state_cost(jnp.array([s, 0, 0, 0])) for s in (-0.5, -0.3, 0.3, 0.5)])
    plain = numbers.weights[0] * np.array([0.25, 0.09, 0.09, 0.25])
    # The middle is at -0.1 m: the right end is 0.2 m nearer.
    height = 5 * numbers.weights[0] * (0.8 * 0.4) ** 2
    np.testing.assert_allclose((ends - plain)[[0, 2]], height / (1 + np.exp(-2.0)), rtol=0.01)
    assert (ends - plain)[3] > (ends - plain)[2] > 10 * (ends - plain)[1]
    np.testing.assert_allclose([problem.low[0], problem.high[0]], [-0.5, 0.3])


def test_a_limited_joint_is_no_circle_and_a_run_beyond_its_limits_fails():
    numbers = of_rod(position=[[-0.4, 3.5]])
    plant = own_plant(rod(), numbers)
    assert plant.problem.joints == ("prismatic",) and numbers.turning == (False,)
    idle = evaluate(plant, lambda x: jnp.zeros(1), np.array([[0.1, 0.0], [-0.1, 0.0]]))
    assert not np.isfinite(idle.settled).any()
    inside = starts(plant, "uniform", 100)[:, 0]
    assert inside.min() >= -0.4 and inside.max() <= 3.5


def test_a_goal_that_takes_torque_costs_nothing_where_it_is_held():
    plant = layout(["revolute"], [0], goal=[0.3], hanging=[np.pi], rate=100.0, control=2.5, passive=False)
    problem = own_plant(rod(), own_problem(rod(), plant)).problem
    u = problem.action_cost.policy(jnp.zeros(1))
    np.testing.assert_allclose(u, [-9.81 / 2 * np.sin(0.3)], rtol=1e-9)
    assert abs(float(problem.action_cost.cost(u))) < 1e-12
    with pytest.raises(InputError, match="the limits are"):
        own_problem(rod(), plant._replace(goal=np.array([1.2])))


def test_motors_of_different_strength_have_a_conjugate_each():
    cost, w = stretched(limited_atan(1.0, 3.0), [2.0, 0.1]), jnp.array([0.7, -40.0])
    u = cost.policy(w)
    assert abs(float(u[0])) < 2 and abs(float(u[1])) < 0.1
    assert float(cost.cost(u) + cost.conjugate(w)) == pytest.approx(float(w @ u), rel=1e-9)
    np.testing.assert_allclose(jax.grad(cost.cost)(u), w, rtol=1e-6)


def test_wishes_of_another_count_are_one_line():
    plant = layout(["revolute"], [0], goal=[0.0], hanging=[np.pi], rate=100.0, control=2.5, passive=False)
    with pytest.raises(InputError, match="expected 2 positive numbers"):
        own_problem(rod(), plant, weights=[1.0])
    with pytest.raises(InputError, match="effort is -1"):
        own_problem(rod(), plant, effort=-1.0)


@pytest.mark.slow
def test_iterations_that_stopped_go_on_bit_for_bit():
    plant = own_plant(rod(), of_rod())
    network = value_network(plant.problem, widths=(4,))
    numbers = Iteration(iterations=3, starts=16, seconds=0.2, steps=5, batch=16, kept=2)
    states = []
    whole = fit_values(plant.problem, network, (0,), numbers=numbers, store=lambda seed, state: states.append(state))
    again = fit_values(plant.problem, network, (0,), numbers=numbers, restore=lambda seed, state: states[0])
    jax.tree.map(np.testing.assert_array_equal, again[0].parameters, whole[0].parameters)
    assert [at.validation for at in again[0].history] == [at.validation for at in whole[0].history]


def test_numbers_rebuild_a_problem_from_json():
    import dataclasses
    import json

    from dln_jax.files import as_type

    numbers = own_problem(dynamics(POLE.closed_form), RAIL)
    again = as_type(json.loads(json.dumps(dataclasses.asdict(numbers))), OwnProblem, name="value.json", remedy="")
    assert again == numbers
