"""Plants, costs, settings and evaluation of continuous fitted value iteration (Lutter et al. 2021, arXiv:2105.04682).

As in the published program, angles are zero upright and enter the costs as π sin(θ/2), the action cost is that of
limited controls with the weight b = 4 limit² R/π, and the cart's rail is a barrier in the state cost. The evaluation
integrates by Euler's method at 250 Hz for 5 s, with controls at 125 Hz, clips states that are not on a circle to the
box (`Evaluation`), and returns

    - sum of dt (q(x) + g(u)),

undiscounted, including the walls. This is the reward of the paper, so more is better.
"""

import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.control.closed_loop import UP, outcomes
from dln_jax.control.optimal.action_costs import limited_atan
from dln_jax.control.optimal.fitted import Iteration
from dln_jax.control.optimal.flow import limits
from dln_jax.control.optimal.problem import ControlProblem, from_plant, rates
from dln_jax.control.state_space import Law, circular, error
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.explicit import ExplicitSystem, closed_form
from dln_jax.mechanics.integrators import Method, explicit_euler
from dln_jax.nn.activations import softplus
from dln_jax.scenes.pendulums import cart_pole, rotary_pendulum
from dln_jax.types import JointKind, Scalar

MARGIN = 1e-3
"""Margin of the action cost's range beyond the limit."""
HORIZON = 5.0
"""Time until a cost has the weight `share`, s."""
Where = Literal["down", "uniform"]


class Starts(NamedTuple):
    """Initial states of the published evaluation: near hanging, or at rest anywhere around the circle."""

    down: Sequence[float]
    """Mean [n]."""
    down_variance: Sequence[float]
    uniform: Sequence[float]
    """Half widths around the goal [n]."""


class Evaluation(NamedTuple):
    """Closed loop of an evaluation, by default the published one."""

    rate: float = 250.0
    """Integrator steps per s."""
    seconds: float = 5.0
    held: int = 2
    """Steps for which a control is held."""
    method: Method = explicit_euler
    clipped: bool = True
    """Whether states that are not on a circle are clipped to the box; otherwise a run that leaves `positions` fails."""
    positions: Any = None
    """Limits of the coordinates [d, 2]; `None` for none."""
    near: float = UP
    """Largest angle from the goal that counts as up, rad."""


class ValuePlant(NamedTuple):
    """A control problem with its limits and initial states."""

    problem: ControlProblem
    limit: Any
    """Limit of the controls, N m or N; one, or [m]."""
    starts: Starts
    angles: tuple[int, ...]
    """Coordinates that must come near the goal."""
    rest: float = 0.0
    """Cost per second of the published costs at the goal; the problem's costs are zero there."""
    evaluation: Evaluation = Evaluation()


class ValueSettings(NamedTuple):
    """Network and iteration of a fit."""

    widths: tuple[int, ...]
    numbers: Iteration
    scale: float = 10.0


class Returns(NamedTuple):
    """Returns of runs from several initial states."""

    returns: Float[np.ndarray, " N"]
    settled: Float[np.ndarray, " N"]
    """Time in s after which the pole stays upright; infinite if it is not upright at the end."""
    largest: float
    """The largest control."""
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
    problem = _problem(rod, None, ("revolute",), (1.0, 0.1), 0.5, 2.5, 0.65, (math.pi, 8.0))
    starts = Starts((math.pi, 0.01), (1e-3, 1e-6), (math.pi, 0.01))
    return ValuePlant(problem, 2.5, starts, (0,))


def cart_pole_on_rail() -> ValuePlant:
    """Returns a desktop cart-pole on a rail of 1 m, with 12 N."""
    scene = cart_pole(cart_mass=0.57, pole_mass=0.127, length=0.16825)
    plant = scene.closed_form._replace(
        dissipation=lambda q, qd: 0.05 * qd[0] ** 2 + 0.0005 * qd[1] ** 2,
        friction=lambda q, qd: jnp.stack([0.1 * qd[0], 1e-3 * qd[1]]),
    )
    box, penalised = (0.5, math.pi, 5.0, 20.0), (0.4, 1.1 * math.pi, 5.5, 22.0)
    joints, weights = scene.needs.joints, (25.0, 1.0, 0.5, 0.1)
    problem = _problem(plant, scene.needs.actuation, joints, weights, 0.1, 12.0, 0.80, box, penalised)
    starts = Starts((0.0, math.pi, 0.0, 0.0), (1e-3, 5e-2, 1e-6, 1e-6), (0.15, math.pi, 0.01, 0.01))
    rest = 5 * 25.0 * 0.4**2 / (1 + math.exp(20 * 0.4))
    return ValuePlant(problem, 12.0, starts, (1,), rest)


def desktop_rotary_pendulum() -> ValuePlant:
    """Returns a desktop rotary pendulum with 50 mN m; the costs are ours, because the paper does not print its own.

    Half of the limit costs 11 per second, as much as hanging: with cheaper controls the iterations do not converge.
    """
    scene = rotary_pendulum(friction=1e-5)
    box, weights = (math.pi, math.pi, 15.0, 28.0), (0.5, 1.0, 0.005, 0.01)
    problem = _problem(scene.closed_form, scene.needs.actuation, scene.needs.joints, weights, 3e5, 0.05, 0.80, box)
    starts = Starts((0.0, math.pi, 0.0, 0.0), (1e-3, 5e-2, 1e-6, 1e-6), (0.3, math.pi, 0.01, 0.01))
    return ValuePlant(problem, 0.05, starts, (1,))


PLANTS = {"pendulum": pendulum, "cart-pole": cart_pole_on_rail, "rotary-pendulum": desktop_rotary_pendulum}
"""Plants by name."""
_PENDULUM = Iteration(iterations=48, starts=1536, kept=6, slope_weight=0.1, floor=0.01)
_CART_POLE = _PENDULUM._replace(
    iterations=80, starts=2048, steps=250, dt=0.0125, seconds=1.5, first_memory=0.1, memory=5.0
)
_ROTARY_PENDULUM = _CART_POLE._replace(
    iterations=60, dt=0.0075, seconds=0.9, first_memory=0.06, memory=1.0, followed=4.0
)
FITS = {
    "pendulum": ValueSettings((96, 96, 96), _PENDULUM),
    "cart-pole": ValueSettings((96, 96, 96), _CART_POLE),
    "rotary-pendulum": ValueSettings((96, 96, 96), _ROTARY_PENDULUM),
}
"""Settings of the fits by plant."""


def starts(plant: ValuePlant, where: Where, count: int = 100, seed: int = 0) -> Float[np.ndarray, "N n"]:
    """Returns random initial states, as published."""
    random, (mean, variance, widths) = np.random.default_rng(seed), plant.starts
    if where == "down":
        return np.asarray(mean) + np.sqrt(variance) * random.normal(size=(count, len(mean)))
    problem = plant.problem
    x = np.asarray(problem.goal) + random.uniform(-1, 1, (count, len(mean))) * np.asarray(widths)
    return np.clip(x, *limits(problem))


def evaluate(plant: ValuePlant, law: Law, x: Any) -> Returns:
    """Evaluates a law x [n] -> u [m] from states x [N, n]; the return is NaN where it fails."""
    problem, how = plant.problem, plant.evaluation
    dt, angles = 1 / how.rate, np.array(plant.angles)
    low, high = limits(problem) if how.clipped else (-np.inf, np.inf)
    field, goal = rates(problem), jnp.asarray(problem.goal, float)

    def sample(carry: tuple[Array, Array], _: Any) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        x, total = carry
        u = jnp.clip(law(x), -plant.limit, plant.limit)
        step = how.method(lambda t, x: field(x, u))
        for _ in range(how.held):
            total = total - dt * (problem.state_cost(x) + plant.rest + problem.action_cost.cost(u))
            x = jnp.clip(step(0.0, x, dt), low, high)
        return (x, total), (x, u)

    def run(x: Array) -> tuple[Array, Array, Array, Array]:
        steps = round(how.seconds * how.rate / how.held)
        (_, total), (later, u) = jax.lax.scan(sample, (x, jnp.zeros(())), length=steps)
        every = jnp.concatenate([x[None], later])
        off = jnp.max(jnp.abs(jax.vmap(lambda x: error(x, goal, problem.joints))(every)[:, angles]), axis=1)
        if how.positions is not None:
            q = every[:, : len(how.positions)]
            inside = jnp.all((q >= how.positions[:, 0]) & (q <= how.positions[:, 1]))
            off = jnp.where(inside, off, jnp.inf)
        return total, every, u, off

    totals, states, controls, off = map(np.asarray, jax.jit(jax.vmap(run))(jnp.asarray(x, float)))
    # Angles above π are far, whatever their cosine.
    settled = outcomes(np.minimum(off, np.pi), rate=how.rate / how.held, up=how.near).seconds
    return Returns(totals, settled, float(np.max(np.abs(controls))), states, controls)


def _problem(
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
