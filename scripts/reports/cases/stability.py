"""Measure how long a chaotic double pendulum is predicted, beside what its Lyapunov exponent allows.

The score is the median time until a prediction is 1 rad off, in units of the time that rounding allows.
"""

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.integrators import rk4, second_order
from dln_jax.scenes.pendulums import double_pendulum
from scripts.reports.run import AtLeast, Case, Numbers

DT = 0.002
"""Time step, s."""
STARTS = np.array([[2.0, 2.5], [2.2, -1.5], [-2.6, 2.0], [1.8, 3.0]])
"""Initial angles at rest, rad; all above the energy where the motion becomes chaotic."""


def measure_horizons(*, steps: int = 100_000) -> Numbers:
    """Largest Lyapunov exponents of the double pendulum, and the time that predictions last.

    The exponent lambda is the mean rate at which ln |v| grows, v carried by the derivative of the step. Two forms of
    the same equations, which differ by rounding alone, diverge after ln(1/eps) / lambda. No integrator can do better.
    """
    scene = double_pendulum()
    x, growth = motions(dynamics(scene.energies), steps)
    other, _ = motions(dynamics(scene.closed_form), steps)
    lost = ~(abs(other - x)[..., :2].max(axis=2) < 1.0)
    seen = np.where(lost.any(axis=1), DT * (1 + lost.argmax(axis=1)), np.inf)
    exponents = growth.mean(axis=1) / DT
    score = np.median(seen * exponents) / np.log(1 / np.finfo(np.float64).eps)
    return {
        "lyapunov/double-pendulum": {"lyapunov_times": exponents.min() * DT * steps},
        "lyapunov/rounding": {"horizon_score": score, "horizon_score_upper": score},
    }


def motions(system: Dynamics, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """States [K, S, 4] of free motions by the classical Runge-Kutta method, and the growth of ln |v| in each step."""
    step = rk4(second_order(lambda t, q, qd: system.forward_dynamics(q, qd, jnp.zeros_like(q))))

    def advance(carry, _):
        end, tangent = jax.jvp(lambda x: jnp.concatenate(step(0.0, (x[:2], x[2:]), DT)), carry[:1], carry[1:])
        growth = jnp.linalg.norm(tangent)
        return (end, tangent / growth), (end, jnp.log(growth))

    def motion(q):
        return jax.lax.scan(advance, (jnp.concatenate([q, jnp.zeros(2)]), jnp.full(4, 0.5)), length=steps)[1]

    x, growth = jax.jit(jax.vmap(motion))(STARTS)
    return np.asarray(x), np.asarray(growth)


CASES = (
    Case(
        "lyapunov-time/double-pendulum",
        measure_horizons,
        quick={"steps": 40_000},
        published={"horizon_score": 1.0, "horizon_score_upper": 1.0},
        bound={"lyapunov_times": AtLeast(10.0), "horizon_score": AtLeast(0.5), "horizon_score_upper": 2.0},
    ),
)
