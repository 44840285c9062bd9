"""Constraints that contradict each other are refused before anything is solved."""

import jax
import jax.numpy as jnp
import numpy as np
from calls import one_line

from dln_jax.control.constraints import require_end
from dln_jax.control.shooting import shoot
from dln_jax.control.trajectories import TrajectoryProblem

RAIL = np.array([0.6, np.inf])
BLOCK = TrajectoryProblem(
    lambda x, u: jnp.stack([x[0] + 0.1 * x[1], x[1] + 0.1 * u[0]]),
    lambda x, u: u @ u,
    lambda x: 0.0 * x[0],
    lower_x=-RAIL,
    upper_x=RAIL,
)


def test_an_end_beyond_the_limits_is_refused():
    timed = {"end": lambda x, t: x[:1] - t, "knots": np.array([0.0, 0.5, 1.0])}
    for change, message in (
        ({"end": lambda x: jnp.stack([x[1], x[0] - 1.0])}, "equation 1 of the end is at least 0.4 from zero"),
        ({"end": lambda x: jnp.stack([-2 * x[0] - 1.5])}, "equation 0 of the end is at least 0.3 from zero"),
        ({"end_below": lambda x: jnp.stack([x[1], 1.4 - 2 * x[0]])}, "inequality 1 of the end is at least 0.2"),
        (timed, "equation 0 of the end is at least 0.4 from zero"),
    ):
        with one_line(message):
            require_end(BLOCK._replace(**change), 2, 1)


def test_ends_that_can_be_met_or_are_not_linear_are_not_refused():
    for change in (
        {"end": lambda x: jnp.stack([x[0] - 0.6, x[1] - 100.0])},
        {"end_below": lambda x: jnp.stack([1.4 - 2 * x[0]]), "soft": (1e3, 1e3)},
        {"end": lambda x: jnp.cos(3 * x[:1])},
        # Linear near its middle, zero at 0.5.
        {"end": lambda x: jnp.stack([0.1 * x[0] - 0.1 + jnp.where(x[0] > 0.4, x[0] - 0.4, 0.0) * 0.5])},
    ):
        require_end(BLOCK._replace(**change), 2, 1)


def test_contradictions_are_found_while_a_caller_traces():
    def traced(x, place):
        return shoot(BLOCK._replace(end=lambda x: x[:1] - place), x, np.zeros((3, 2)), np.zeros((2, 1)))

    with one_line(r"is at least 0\.4"):
        jax.eval_shape(lambda x: traced(x, 1.0), np.zeros(2))
    with one_line("the start violates the upper limit of state 0 at knot 0 by 0.4"):
        jax.eval_shape(lambda: traced(np.array([1.0, 0.0]), 0.0))
    # Traced numbers cannot be checked.
    jax.eval_shape(lambda place: traced(np.zeros(2), place), 1.0)
