"""The problem of one's own plant has the plant's scales, and its iterations go on as if they had never stopped."""

import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line

from dln_jax.commands.values.evaluation import anywhere, simulated
from dln_jax.control.optimal.own_plants import own_plant, own_problem, own_settings
from dln_jax.control.plants.plant import layout
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.explicit import closed_form
from dln_jax.scenes.pendulums import cart_pole


def rod(length=1.0):
    """A driven rod of 1 kg."""
    return dynamics(
        closed_form(
            lambda q: jnp.full((1, 1), length**2 / 3, q.dtype),
            lambda q, qd: jnp.zeros_like(q),
            lambda q: 9.81 * length / 2 * jnp.cos(q[0]),
            lambda q: -9.81 * length / 2 * jnp.sin(q),
        )
    )


def driven(goal=0.0, control=2.5, **options):
    settings = {"hanging": [np.pi], "rate": 100.0, "passive": False, **options}
    return layout(["revolute"], [0], goal=[goal], control=control, **settings)


def of_rod(length=1.0, control=2.5, **options):
    return own_problem(rod(length), driven(control=control, **options))


POLE = cart_pole(cart_mass=0.57, pole_mass=0.127, length=0.16825)
RAIL = layout(
    ["prismatic", "revolute"],
    [0],
    goal=[0.0, 0.0],
    hanging=[0.0, np.pi],
    rate=100.0,
    control=12.0,
    position=[[-0.5, 0.3], [-np.inf, np.inf]],
)


def test_rod_has_the_scales_of_its_closed_form():
    short, long = of_rod(), of_rod(4.0, 10.0)
    assert short.scale == pytest.approx(np.sqrt(1.5 * 9.81), rel=1e-9)
    assert long.scale == pytest.approx(short.scale / 2, rel=1e-9)
    numbers, slower = own_settings(short)[0], own_settings(long)[0]
    for name in ("dt", "seconds", "memory"):
        assert getattr(slower, name) == pytest.approx(2 * getattr(numbers, name))
    problem = own_plant(rod(), short)
    assert own_plant(rod(4.0), long).discount == pytest.approx(problem.discount / 2)
    # Hanging costs π² / 2, half of the motor's limit a share of it.
    assert problem.state_cost(jnp.array([np.pi, 0.0])) == pytest.approx(0.5 * np.pi**2)  # driven
    assert problem.action_cost.cost(jnp.array([1.25])) == pytest.approx(0.25 * np.pi**2)
    # A strong motor sets the pace.
    assert of_rod(control=1e4).scale == pytest.approx(np.sqrt(3e4 / np.pi))


def test_barriers_rise_at_the_ends_of_the_rail():
    numbers = own_problem(dynamics(POLE.closed_form), RAIL)
    problem = own_plant(dynamics(POLE.closed_form), numbers)
    ends = np.array([problem.state_cost(jnp.array([s, 0, 0, 0])) for s in (-0.5, -0.3, 0.3, 0.5)])
    plain = numbers.weights[0] * np.array([0.25, 0.09, 0.09, 0.25])
    # The middle is at -0.1 m: the right end is 0.2 m nearer.
    height = 5 * numbers.weights[0] * (0.8 * 0.4) ** 2
    np.testing.assert_allclose((ends - plain)[[0, 2]], height / (1 + np.exp(-2.0)), rtol=0.01)
    assert (ends - plain)[3] > (ends - plain)[2] > 10 * (ends - plain)[1]
    np.testing.assert_allclose([problem.low[0], problem.high[0]], [-0.5, 0.3])


def test_a_limited_joint_is_no_circle_and_a_run_beyond_its_limits_fails():
    numbers = of_rod(position=[[-0.4, 3.5]])
    problem = own_plant(rod(), numbers)
    assert problem.joints == ("prismatic",) and numbers.turning == (False,)
    _, settled = simulated(problem, numbers, lambda x: jnp.zeros(1), np.array([[0.1, 0.0], [-0.1, 0.0]]))
    assert not np.isfinite(settled).any()
    inside = anywhere(problem, numbers, 100)[:, 0]
    assert inside.min() >= -0.4 and inside.max() <= 3.5


def test_weights_and_efforts_out_of_range_are_refused():
    for wishes, message in (({"weights": [1.0]}, "expected 2 positive numbers"), ({"effort": -1.0}, "effort is -1")):
        with one_line(message):
            own_problem(rod(), driven(), **wishes)
    with one_line("the limits are"):
        own_problem(rod(), driven(1.2))  # the weight is more than the motor
