"""How long a chaotic motion is predicted, in units of what its Lyapunov exponent allows."""

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.mechanics import integrators, natural
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.integrators import rk4, second_order
from dln_jax.rollout import rollout
from dln_jax.scenes.pendulums import double_pendulum
from scripts.reports.run import Numbers

DT, COARSE = 0.002, 5
"""Time step, s, and the coarser one as a multiple."""
SEPARATION = 1e-7
"""Constant distance of the second motion, rad."""
STARTS = np.array([[2.0, 2.5], [2.2, -1.5], [-2.6, 2.0], [1.8, 3.0]])
"""Initial angles at rest, rad; all above the energy where the motion becomes chaotic."""


def measure_horizons(*, steps: int = 100_000) -> Numbers:
    """Largest Lyapunov exponents of the double pendulum, by two methods, and the time that predictions last.

    The exponent lambda is the mean rate at which ln |v| grows, v carried by the derivative of the step, and, apart from
    that, at which a second motion departs that is rescaled after every step (Benettin, Galgani, Giorgilli and Strelcyn
    1980). Two forms of the same equations, which differ by rounding alone, diverge after ln(1/eps) / lambda; a motion
    with a step error e diverges after ln(1/e) / lambda. No integrator can do better.
    """
    scene = double_pendulum()
    system = dynamics(scene.energies)
    step = step_of(system)

    def flow(x):
        return jnp.concatenate(step(0.0, (x[:2], x[2:]), DT))

    def advance(carry, _):
        x, tangent, pair = carry
        end, tangent = jax.jvp(flow, (x,), (tangent,))
        other = flow(x + SEPARATION * pair) - end
        growth, distance = jnp.linalg.norm(tangent), jnp.linalg.norm(other)
        return (end, tangent / growth, other / distance), (end, jnp.log(growth), jnp.log(distance / SEPARATION))

    def motion(q):
        x = jnp.concatenate([q, jnp.zeros_like(q)])
        direction = jnp.full(4, 0.5)
        return rollout(advance, (x, direction, direction), steps=steps, observe=lambda state, seen: seen)[1]

    def cholesky(q):  # the same mass matrix, rounded otherwise
        mass = scene.mass_matrix(q)
        first = jnp.sqrt(mass[0, 0])
        below = mass[0, 1] / first
        return jnp.array([[first, 0.0], [below, jnp.sqrt(mass[1, 1] - below**2)]])

    x, tangent, pair = map(np.asarray, jax.jit(jax.vmap(motion, out_axes=1))(STARTS))
    exponents, by_pairs = tangent.mean(axis=0) / DT, pair.mean(axis=0) / DT
    t = DT * np.arange(1, steps + 1)
    rounded = departure(x, natural.dynamics(natural.NaturalSystem(cholesky, scene.potential)), every=1)
    coarse, coarse_t = departure(x, system, every=COARSE), t[COARSE - 1 :: COARSE]
    # A coarse step's error is the distance after one Lyapunov time, from where it grows e-fold in each.
    after_one = np.array([coarse[coarse_t <= 1 / rate, k].max() for k, rate in enumerate(exponents)])
    allowed = np.log(1 / np.finfo(np.float64).eps) / exponents, (1 + np.log(1 / after_one)) / exponents
    seen = horizon(rounded, t), horizon(coarse, coarse_t)
    scores = [float(np.median(time / expected)) for time, expected in zip(seen, allowed, strict=True)]
    return {
        "lyapunov/double-pendulum": {
            "lyapunov_times": float(exponents.min() * t[-1]),
            "exponents_relative_difference": float(abs(by_pairs / exponents - 1).max()),
        },
        "lyapunov/rounding": {"horizon_score": scores[0], "horizon_score_upper": scores[0]},
        "lyapunov/coarse-step": {"horizon_score": scores[1], "horizon_score_upper": scores[1]},
    }


def step_of(system: Dynamics):
    """The classical Runge-Kutta step of a free motion."""
    return rk4(second_order(lambda t, q, qd: system.forward_dynamics(q, qd, jnp.zeros_like(q))))


def departure(x: np.ndarray, system: Dynamics, *, every: int) -> np.ndarray:
    """Largest difference of angles in rad from the motion by another system or step, [S / every, K]."""
    t = every * DT * jnp.arange(len(x) // every + 1)

    @jax.jit
    def motions(starts):
        one = lambda q: integrators.rollout(step_of(system), (q, jnp.zeros_like(q)), t)[0]  # noqa: E731
        return jax.vmap(one, out_axes=1)(starts)

    return abs(np.asarray(motions(STARTS))[1:] - x[every - 1 :: every, :, :2]).max(axis=-1)


def horizon(distance: np.ndarray, t: np.ndarray) -> np.ndarray:
    """First times when motions are 1 rad off; infinite if they never are."""
    lost = ~(distance < 1.0)
    return np.where(lost.any(axis=0), t[np.argmax(lost, axis=0)], np.inf)
