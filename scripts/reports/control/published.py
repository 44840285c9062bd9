"""Plants, costs, settings and evaluation of continuous fitted value iteration (Lutter et al. 2021, arXiv:2105.04682).

The equations are those of the library's files of the same names. As in the published program, angles are zero upright
and enter the costs as π sin(θ/2), the action cost is that of limited controls with the weight b = 4 limit² R/π, and the
cart's rail is a barrier in the state cost. The evaluation integrates by Euler's method at 250 Hz for 5 s, with controls
at 125 Hz, clips states that are not on a circle to the box, and returns

    - sum of dt (q(x) + g(u)),

undiscounted, including the walls. This is the reward of the paper, so more is better.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.control.closed_loop import outcomes
from dln_jax.control.optimal.action_costs import limited_atan
from dln_jax.control.optimal.fitted import Iteration
from dln_jax.control.optimal.own_plants import MARGIN
from dln_jax.control.optimal.problem import ControlProblem, from_plant, limits, rates
from dln_jax.control.state_space import Law, circular
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.explicit import ExplicitSystem, closed_form
from dln_jax.mechanics.integrators import explicit_euler
from dln_jax.nn.activations import softplus
from dln_jax.scenes.pendulums import cart_pole, rotary_pendulum
from dln_jax.types import JointKind, Scalar

HORIZON = 5.0
"""Time until a cost has the weight `share`, s."""
RATE, SECONDS, HELD = 250.0, 5.0, 2
"""Integrator steps per s, duration, and steps for which a control is held."""
HANGING = (0.0, math.pi, 0.0, 0.0), (1e-3, 5e-2, 1e-6, 1e-6)
WIDTHS, SCALE = (96, 96, 96), 10.0
"""Widths of the networks, and the factor on their V."""
PENDULUM = Iteration(iterations=48, starts=1536, kept=6, slope_weight=0.1, floor=0.01)
CART_POLE = PENDULUM._replace(
    iterations=80, starts=2048, steps=250, dt=0.0125, seconds=1.5, first_memory=0.1, memory=5.0
)
FITS = {
    "pendulum": PENDULUM,
    "cart-pole": CART_POLE,
    "rotary-pendulum": CART_POLE._replace(
        iterations=60, dt=0.0075, seconds=0.9, first_memory=0.06, memory=1.0, followed=4.0
    ),
}
"""Settings of the fits by plant."""


class ValuePlant(NamedTuple):
    """A control problem with its limit and initial states."""

    problem: ControlProblem
    limit: float
    """Limit of the control, N m or N."""
    down: tuple[Sequence[float], Sequence[float]]
    """Mean and variance [n] of starts near hanging."""
    uniform: Sequence[float]
    """Half widths [n] of starts around the goal."""
    rest: float = 0.0
    """Cost per second of the published costs at the goal; the problem's costs are zero there."""


class Returns(NamedTuple):
    """Runs from several initial states."""

    returns: Float[np.ndarray, " N"]
    settled: Float[np.ndarray, " N"]
    """Time in s after which the pole stays upright; infinite if it is not upright at the end."""
    x: Float[np.ndarray, "N T n"]
    u: Float[np.ndarray, "N T-1 m"]


def pendulum() -> ValuePlant:
    """Returns a driven rod of 1 kg and 1 m: thdd = 3 (u + g/2 sin θ). Its 2.5 N m are too weak to lift it at once."""
    weight = 9.81 / 2
    rod = closed_form(
        lambda q: jnp.full((1, 1), 1 / 3, q.dtype),
        lambda q, qd: jnp.zeros_like(q),
        lambda q: weight * jnp.cos(q[0]),
        lambda q: -weight * jnp.sin(q),
    )
    problem = discounted(rod, None, ("revolute",), (1.0, 0.1), 0.5, 2.5, 0.65, (math.pi, 8.0))
    return ValuePlant(problem, 2.5, ((math.pi, 0.01), (1e-3, 1e-6)), (math.pi, 0.01))


def cart_pole_on_rail() -> ValuePlant:
    """Returns a desktop cart-pole on a rail of 1 m, with 12 N."""
    scene = cart_pole(cart_mass=0.57, pole_mass=0.127, length=0.16825)
    plant = scene.closed_form._replace(
        dissipation=lambda q, qd: 0.05 * qd[0] ** 2 + 0.0005 * qd[1] ** 2,
        friction=lambda q, qd: jnp.stack([0.1 * qd[0], 1e-3 * qd[1]]),
    )
    box, penalised = (0.5, math.pi, 5.0, 20.0), (0.4, 1.1 * math.pi, 5.5, 22.0)
    joints, weights = scene.needs.joints, (25.0, 1.0, 0.5, 0.1)
    problem = discounted(plant, scene.needs.actuation, joints, weights, 0.1, 12.0, 0.80, box, penalised)
    rest = 5 * 25.0 * 0.4**2 / (1 + math.exp(20 * 0.4))
    return ValuePlant(problem, 12.0, HANGING, (0.15, math.pi, 0.01, 0.01), rest)


def desktop_rotary_pendulum() -> ValuePlant:
    """Returns a desktop rotary pendulum with 50 mN m; the costs are ours, because the paper does not print its own.

    Half of the limit costs 11 per second, as much as hanging: with cheaper controls the iterations do not converge.
    """
    scene = rotary_pendulum(friction=1e-5)
    box, weights = (math.pi, math.pi, 15.0, 28.0), (0.5, 1.0, 0.005, 0.01)
    problem = discounted(scene.closed_form, scene.needs.actuation, scene.needs.joints, weights, 3e5, 0.05, 0.80, box)
    return ValuePlant(problem, 0.05, HANGING, (0.3, math.pi, 0.01, 0.01))


PLANTS = {"pendulum": pendulum, "cart-pole": cart_pole_on_rail, "rotary-pendulum": desktop_rotary_pendulum}
"""Plants by name."""


def starts(plant: ValuePlant, where: str, count: int = 100) -> Float[np.ndarray, "N n"]:
    """Random initial states, as published."""
    random, (mean, variance) = np.random.default_rng(0), plant.down
    if where == "down":
        return np.asarray(mean) + np.sqrt(variance) * random.normal(size=(count, len(mean)))
    x = np.asarray(plant.problem.goal) + random.uniform(-1, 1, (count, len(mean))) * np.asarray(plant.uniform)
    return np.clip(x, *limits(plant.problem))


def evaluate(plant: ValuePlant, law: Law, x: Any) -> Returns:
    """Runs of a law x [n] -> u [m] from states x [N, n]; the return is NaN where it fails."""
    problem, dt, (low, high) = plant.problem, 1 / RATE, limits(plant.problem)
    field = rates(problem)

    def sample(carry, _):
        x, total = carry
        u = jnp.clip(law(x), -plant.limit, plant.limit)
        step = explicit_euler(lambda t, x: field(x, u))
        for _ in range(HELD):
            total = total - dt * (problem.state_cost(x) + plant.rest + problem.action_cost.cost(u))
            x = jnp.clip(step(0.0, x, dt), low, high)
        return (x, total), (x, u)

    def run(x):
        (_, total), (later, u) = jax.lax.scan(sample, (x, jnp.zeros(())), length=round(SECONDS * RATE / HELD))
        return total, jnp.concatenate([x[None], later]), u

    totals, states, controls = map(np.asarray, jax.jit(jax.vmap(run))(jnp.asarray(x, float)))
    # The pole is the last coordinate.
    settled = outcomes(states[..., len(problem.joints) - 1], rate=RATE / HELD).seconds
    return Returns(totals, settled, states, controls)


def discounted(
    plant: ExplicitSystem,
    actuation: Sequence[Sequence[float]] | None,
    joints: tuple[JointKind, ...],
    weights: Sequence[float],
    R: float,
    limit: float,
    share: float,
    box: Sequence[float],
    penalised: Sequence[float] | None = None,
) -> ControlProblem:
    """A problem with the published costs; the barriers begin at the penalised states."""
    a, B = from_plant(dynamics(plant), actuation)
    angles = circular(joints, len(box))

    def ways(x: Any) -> list[Any]:
        return [math.pi * jnp.sin(part / 2) if angle else part for part, angle in zip(x, angles, strict=True)]

    def state_cost(x: Array) -> Scalar:
        return sum((weight * way**2 for weight, way in zip(weights, ways(x), strict=True)), jnp.zeros((), x.dtype))

    def with_walls(x: Array) -> Scalar:
        # The walls begin at 0.4 m of the rail's 0.5 m. Their cost at the goal, where costs are zero, is subtracted.
        wrapped = [
            part - 2 * math.pi * jnp.round(part / (2 * math.pi)) if angle else part
            for part, angle in zip(x, angles, strict=True)
        ]
        return state_cost(x) + sum(
            (
                height * (softplus.first(20 * (jnp.abs(part) - edge)) - 1 / (1 + math.exp(20 * edge)))
                for height, part, edge in zip(heights, wrapped, penalised or (), strict=True)
            ),
            jnp.zeros((), x.dtype),
        )

    heights = [5 * weight * float(way) ** 2 for weight, way in zip(weights, ways(penalised or box), strict=True)]
    cost = limited_atan(limit + MARGIN, 4 * limit**2 * R / math.pi)
    high, charged = np.array(box), with_walls if penalised else state_cost
    return ControlProblem(a, B, charged, cost, -math.log(share) / HORIZON, -high, high, joints, np.zeros(len(box)))
