"""Values from the equation itself: linear-quadratic ones exactly, another by quadrature, and which of two solutions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from scipy.integrate import quad
from scipy.optimize import brentq

from dln_jax.control.optimal.action_costs import limited_atan, quadratic
from dln_jax.control.optimal.problem import ControlProblem
from dln_jax.control.optimal.value_networks import discounts_down_to, fit_hjb, value_network

LINE = ControlProblem(
    lambda x: x, lambda x: jnp.ones((1, 1)), lambda x: 0.5 * x @ x, quadratic(1.0), 0.0, [-5.0], [5.0], (), [0.0]
)
"""dx/dt = x + u with the cost (x² + u²)/2: V = x² (1 + √2)/2."""
FEW = {"samples": 64, "validation": 64}
KEY = jax.random.key(1)
FORM = lambda theta, x: (theta * x[0] ** 2, 2 * theta * x)  # noqa: E731


def test_continuation_comes_to_the_cost_to_go_and_not_to_the_other_solution():
    for discounts, sign in ((discounts_down_to(0.0, first=100.0), 1), ([0.0], -1)):
        fit = fit_hjb(LINE, FORM, jnp.asarray(-3.0), KEY, discounts=discounts, **FEW)
        assert fit.parameters == pytest.approx((1 + sign * np.sqrt(2)) / 2, rel=1e-12)


def test_a_network_has_the_value_of_limited_controls():
    limit, weight = 5.5, 2 * 5.5 / np.pi
    problem = LINE._replace(action_cost=limited_atan(limit, weight))
    network = value_network(problem, widths=(8,), scale=100.0)
    settings = {"iterations": 40, "rounds": 3, "samples": 128, "validation": 128}
    fit = fit_hjb(problem, network.value_and_gradient, network.init(KEY), KEY, **settings)

    def slope(x):
        """The root of g*(-s) = x²/2 + x s at which u goes home; the equation has no other part, as rho is 0."""
        gain = lambda s: limit / np.pi * (2 * s * np.arctan(s / weight) - weight * np.log1p((s / weight) ** 2))  # noqa: E731
        return brentq(lambda s: gain(s) - x * s - x**2 / 2, weight * np.tan(np.pi * x / (2 * limit)), 1e4, xtol=1e-12)

    for x in (0.5, 2.0, 4.0, 4.9):
        value, found = network.value_and_gradient(fit.parameters, jnp.array([x]))
        assert value == pytest.approx(quad(slope, 0, x)[0], rel=5e-3)
        assert found[0] == pytest.approx(slope(x), rel=5e-3)


def test_problems_that_cannot_be_fitted_are_refused():
    for change, message in (
        ({"discounts": [3.0]}, "ends with the problem's, 0.0"),
        ({"samples": 0}, "samples is 0"),
        ({"problem": LINE._replace(state_cost=lambda x: x[0] ** 2 / (jnp.abs(x[0]) < 4))}, "not finite"),
    ):
        settings = {"problem": LINE, "discounts": [0.0], **FEW, **change}
        with one_line(message):
            fit_hjb(settings.pop("problem"), FORM, jnp.asarray(1.0), KEY, **settings)
    with one_line("ratio is 1"):
        discounts_down_to(0.2, ratio=1.0)
