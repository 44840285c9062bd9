"""Measure how long a chaotic double pendulum is predicted, beside what its Lyapunov exponent allows.

Scores are median times until a prediction is 1 rad off, in units of the time that theory allows.
"""

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.integrators import rk4, rollout, second_order
from dln_jax.scenes.pendulums import double_pendulum
from scripts.reports.run import AtLeast, Case, Numbers

DT, COARSE = 0.002, 5
"""Time step, s, and the coarser one as a multiple."""
STARTS = np.array([[2.0, 2.5], [2.2, -1.5], [-2.6, 2.0], [1.8, 3.0]])
"""Initial angles at rest, rad; all above the energy where the motion becomes chaotic."""


def measure_horizons(*, steps: int = 100_000) -> Numbers:
    """Largest Lyapunov exponents of the double pendulum, and the time that predictions last.

    The exponent lambda is the mean rate at which ln |v| grows, v carried by the derivative of the step. Two forms of
    the same equations, which differ by rounding alone, diverge after ln(1/eps) / lambda; a motion with a step error e
    diverges after ln(1/e) / lambda. No integrator can do better.
    """
    scene = double_pendulum()
    system = dynamics(scene.energies)
    step = step_of(system)

    def motion(q):
        def advance(carry, _):
            x, tangent = carry
            end, tangent = jax.jvp(lambda x: jnp.concatenate(step(0.0, (x[:2], x[2:]), DT)), (x,), (tangent,))
            growth = jnp.linalg.norm(tangent)
            return (end, tangent / growth), (end, jnp.log(growth))

        return jax.lax.scan(advance, (jnp.concatenate([q, jnp.zeros(2)]), jnp.full(4, 0.5)), length=steps)[1]

    x, growth = map(np.asarray, jax.jit(jax.vmap(motion, out_axes=1))(STARTS))
    exponents, t = growth.mean(axis=0) / DT, DT * np.arange(1, steps + 1)
    rounded = departure(x, dynamics(scene.closed_form), every=1)
    coarse, coarse_t = departure(x, system, every=COARSE), t[COARSE - 1 :: COARSE]
    # A coarse step's error is the distance after one Lyapunov time, from where it grows e-fold in each.
    after_one = np.array([coarse[coarse_t <= 1 / rate, k].max() for k, rate in enumerate(exponents)])
    allowed = np.log(1 / np.finfo(np.float64).eps) / exponents, (1 + np.log(1 / after_one)) / exponents
    seen = horizon(rounded, t), horizon(coarse, coarse_t)
    scores = [np.median(time / expected) for time, expected in zip(seen, allowed, strict=True)]
    return {
        "lyapunov/double-pendulum": {"lyapunov_times": exponents.min() * t[-1]},
        "lyapunov/rounding": {"horizon_score": scores[0], "horizon_score_upper": scores[0]},
        "lyapunov/coarse-step": {"horizon_score": scores[1], "horizon_score_upper": scores[1]},
    }


def step_of(system: Dynamics):
    """The classical Runge-Kutta step of a free motion."""
    return rk4(second_order(lambda t, q, qd: system.forward_dynamics(q, qd, jnp.zeros_like(q))))


def departure(x: np.ndarray, system: Dynamics, *, every: int) -> np.ndarray:
    """Largest difference of angles in rad from the motion by another system or step, [S / every, K]."""
    t = every * DT * jnp.arange(len(x) // every + 1)
    motions = jax.vmap(lambda q: rollout(step_of(system), (q, jnp.zeros_like(q)), t)[0], out_axes=1)
    return abs(np.asarray(jax.jit(motions)(STARTS))[1:] - x[every - 1 :: every, :, :2]).max(axis=-1)


def horizon(distance: np.ndarray, t: np.ndarray) -> np.ndarray:
    """First times when motions are 1 rad off; infinite if they never are."""
    lost = ~(distance < 1.0)
    return np.where(lost.any(axis=0), t[np.argmax(lost, axis=0)], np.inf)


CASES = (
    Case(
        "lyapunov-time/double-pendulum",
        measure_horizons,
        quick={"steps": 40_000},
        published={"horizon_score": 1.0, "horizon_score_upper": 1.0},
        bound={"lyapunov_times": AtLeast(10.0), "horizon_score": AtLeast(0.5), "horizon_score_upper": 2.0},
    ),
)
