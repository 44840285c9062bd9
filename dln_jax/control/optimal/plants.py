"""Plants and costs of continuous fitted value iteration (Lutter et al. 2021, arXiv:2105.04682, and its program).

Angles are zero upright and enter the costs as π sin(θ/2). The action cost is that of limited controls with the weight
b = 4 limit² R/π, as in the program. The cart's rail is a barrier in the state cost.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control.optimal.action_costs import limited_atan
from dln_jax.control.optimal.problem import ControlProblem, from_plant
from dln_jax.mechanics import closed_form
from dln_jax.mechanics.closed_form import ClosedForm
from dln_jax.nn.activations import softplus
from dln_jax.scenes.poles import cart_pole, rotary_pendulum
from dln_jax.types import JointKind, Scalar

MARGIN = 1e-3
"""Margin of the action cost's range beyond the limit."""


class Starts(NamedTuple):
    """Initial states of the published evaluation: near hanging, and anywhere around the circle at rest."""

    down: Sequence[float]
    """Mean [n]."""
    down_variance: Sequence[float]
    uniform: Sequence[float]
    """Half widths around the goal [n]."""


class ValuePlant(NamedTuple):
    """A control problem with its limit, initial states and published results."""

    problem: ControlProblem
    limit: float
    """Limit of the control, N m or N."""
    starts: Starts
    angle: int
    """Index of the pole's angle."""
    reference: dict[str, float]
    """Mean returns of the published policies, re-run from initial states whose draw hardly matters."""
    rest: float = 0.0
    """Cost per second of the published costs at the goal; the problem's costs are zero there."""


def pendulum() -> ValuePlant:
    """A driven rod of 1 kg and 1 m: thdd = 3 (u + g/2 sin θ), with 2.5 N m too weak to lift it at once."""
    weight = 9.81 / 2
    rod = ClosedForm(
        lambda q: jnp.full((1, 1), 1 / 3, q.dtype),
        lambda q, qd: jnp.zeros_like(q),
        lambda q: weight * jnp.cos(q[0]),
        lambda q: -weight * jnp.sin(q),
    )
    problem = _problem(rod, None, ("revolute",), (1.0, 0.1), 0.5, 2.5, 0.65, (math.pi, 8.0))
    starts = Starts((math.pi, 0.01), (1e-3, 1e-6), (math.pi, 0.01))
    return ValuePlant(problem, 2.5, starts, 0, {"down": -30.96})


def cart_pole_on_rail() -> ValuePlant:
    """A desktop cart-pole on a rail of 1 m, with 12 N."""
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
    return ValuePlant(problem, 12.0, starts, 1, {"down": -25.05}, rest)


def desktop_rotary_pendulum() -> ValuePlant:
    """A rotary pendulum of desktop size with 50 mN m; the costs are ours, as the published ones are not printed."""
    scene = rotary_pendulum(friction=1e-5)
    box, weights = (math.pi, math.pi, 25.0, 40.0), (0.5, 1.0, 0.005, 0.01)
    problem = _problem(scene.closed_form, scene.needs.actuation, scene.needs.joints, weights, 50.0, 0.05, 0.80, box)
    starts = Starts((0.0, math.pi, 0.0, 0.0), (1e-3, 5e-2, 1e-6, 1e-6), (0.3, math.pi, 0.01, 0.01))
    return ValuePlant(problem, 0.05, starts, 1, {})


PLANTS = {"pendulum": pendulum, "cart-pole": cart_pole_on_rail, "rotary-pendulum": desktop_rotary_pendulum}
"""Plants by name."""
HORIZON = 5.0
"""Time in s after which a cost counts by the factor `share`."""


def _problem(
    plant: ClosedForm,
    actuation: Sequence[Sequence[float]] | None,
    joints: tuple[JointKind, ...],
    weights: Sequence[float],
    R: float,
    limit: float,
    share: float,
    box: Sequence[float],
    penalised: Sequence[float] | None = None,
) -> ControlProblem:
    a, B = from_plant(closed_form.dynamics(plant), actuation)
    circular = [number < len(joints) and joints[number] == "revolute" for number in range(len(box))]

    def ways(x: Any) -> list[Any]:
        return [math.pi * jnp.sin(each / 2) if turns else each for each, turns in zip(x, circular, strict=True)]

    def state_cost(x: Array) -> Scalar:
        return sum((weight * way**2 for weight, way in zip(weights, ways(x), strict=True)), jnp.zeros((), x.dtype))

    def with_walls(x: Array) -> Scalar:
        # The walls begin at 0.4 m of a rail's 0.5 m. Their value at the goal, where costs are zero, is subtracted.
        turned = [
            each - 2 * math.pi * jnp.round(each / (2 * math.pi)) if turns else each
            for each, turns in zip(x, circular, strict=True)
        ]
        return state_cost(x) + sum(
            (
                height * (softplus.first(20 * (jnp.abs(each) - edge)) - 1 / (1 + math.exp(20 * edge)))
                for height, each, edge in zip(heights, turned, penalised or (), strict=True)
            ),
            jnp.zeros((), x.dtype),
        )

    heights = [5 * weight * float(way) ** 2 for weight, way in zip(weights, ways(penalised or box), strict=True)]
    cost = limited_atan(limit + MARGIN, 4 * limit**2 * R / math.pi)
    high = np.array(box)
    return ControlProblem(
        a,
        B,
        with_walls if penalised else state_cost,
        cost,
        -math.log(share) / HORIZON,
        -high,
        high,
        joints,
        np.zeros(len(box)),
    )
