"""Model predictive control of a cart-pole at 100 Hz: swing-ups from many starts.

The plant is the Quanser cart-pole of Lutter et al. 2021 (arXiv 2105.04682) with its viscous friction and a limit of
12 N. Every 10 ms one iteration improves the plan of the previous call. The first plan applies no force: there is no
guess and no solution in advance.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control import Controller, Hardware, Plan, TrajectoryProblem, error, first_plan, mpc, simulate
from dln_jax.control.state_space import Field, field_of
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction import joint_dissipation
from dln_jax.mechanics.integrators import CLASSICAL, runge_kutta
from dln_jax.scenes.poles import cart_pole
from dln_jax.scenes.scene import Scene

RATE, SECONDS, LIMIT, RAIL = 100.0, 6.0, 12.0, 0.5
"""Control rate, Hz, length of a run, s, force limit, N, and half the length of the rail, m."""
HORIZONS = (1.2, 0.8)
"""Horizons of the plans, s."""
HANGING = np.array([0.0, np.pi, 0.0, 0.0])
UP = 0.1
"""Largest angle from upright that counts as up, rad."""


class Weights(NamedTuple):
    """Weights of the cost's integrand, and the factor on the last state's cost."""

    position: float = 4.0
    angle: float = 1.0
    """Weight of 2 (1 - cos)."""
    rates: tuple[float, float] = (0.1, 0.01)
    force: float = 1e-3
    beyond: float = 200.0
    """Weight of the squared excess of the cart's position over nine tenths of the rail, m²."""
    last: float = 20.0


def scene() -> Scene:
    """The plant."""
    known = cart_pole(cart_mass=0.57, pole_mass=0.127, length=0.16825, friction=1.0)
    return known._replace(dissipation=joint_dissipation(np.array([0.1, 1e-3])))


def field() -> Field:
    """The plant's vector field, in closed form, which is cheaper than forces derived from energies."""
    known = scene()
    return field_of(dynamics(known.closed_form), np.asarray(known.needs.actuation))


def cart_pole_problem(weights: Weights = Weights()) -> TrajectoryProblem:  # noqa: B008
    """The optimal control problem: steps of 10 ms by the classical Runge-Kutta method, and their costs."""
    plant, dt = field(), 1.0 / RATE

    def off(x: Array) -> Array:
        beyond = jnp.maximum(jnp.abs(x[0]) - 0.9 * RAIL, 0.0)
        speed = weights.rates[0] * x[2] ** 2 + weights.rates[1] * x[3] ** 2
        return (
            weights.position * x[0] ** 2 + 2 * weights.angle * (1 - jnp.cos(x[1])) + speed + weights.beyond * beyond**2
        )

    return TrajectoryProblem(
        lambda x, u: runge_kutta(CLASSICAL, lambda t, state: plant(state, u))(0.0, x, dt),
        lambda x, u: dt * (off(x) + weights.force * u[0] ** 2),
        lambda x: weights.last * off(x),
        -LIMIT,
        LIMIT,
    )


def starts(count: int, seed: int = 0) -> np.ndarray:
    """Random starts near hanging [count, 4], distributed as in the published evaluation; the cart may be off centre."""
    random = np.random.default_rng(seed)
    return random.normal(size=(count, 4)) * np.sqrt([1e-3, 5e-2, 1e-6, 1e-6]) + HANGING


def controller(problem: TrajectoryProblem, steps: int) -> Controller:
    """A controller of the full state; its memory is the plan, initially without force."""
    act = mpc(problem)
    waiting = first_plan(problem, HANGING, np.zeros((steps, 1)))

    def sample(plan: Plan, t: Array, y: Array) -> tuple[Plan, Array]:
        u, plan = act(y, plan)
        return plan, u

    return Controller(waiting, sample)


def swing_ups(steps: int, count: int, seed: int = 0) -> np.ndarray:
    """Times from which the pole stays up and the cart on its rail, s, by start; infinite for failures."""
    joints, plant, law = scene().needs.joints, field(), controller(cart_pole_problem(), steps)
    lab = Hardware(-LIMIT, LIMIT)

    def up(x: Array) -> Array:
        run = simulate(plant, law, x, seconds=SECONDS, rate=RATE, controls=1, hardware=lab, substeps=4)
        off = jax.vmap(lambda x: error(x, np.zeros(4), joints)[1])(run.x)
        return (jnp.abs(off) < UP) & (jnp.max(jnp.abs(run.x[:, 0])) <= RAIL)

    good = np.asarray(jax.jit(jax.vmap(up))(starts(count, seed)))
    return np.where(good[:, -1], (good.shape[1] - np.argmin(good[:, ::-1], axis=1)) / RATE, np.inf)
