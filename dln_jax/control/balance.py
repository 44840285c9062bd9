"""Regulators on the circle: wrapped errors of angles, the switch from swing-up, and the region of attraction."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool

from dln_jax.control.closed_loop import Controller, Hardware, simulate
from dln_jax.control.finite import where_finite
from dln_jax.control.quadratic import Regulator
from dln_jax.control.state_space import Field
from dln_jax.types import JointKind, Scalar, require_positive

Law = Callable[[Array], Array]
"""x [2 d] -> u [m]."""


class Region(NamedTuple):
    """Region around a goal in which a regulator's own value is below a level."""

    level: float
    """Level of (x - x0)ᵀ S (x - x0)."""
    share: float
    """Share of the tested starts that reached the goal."""


def error(x: Array, goal: Any, joints: tuple[JointKind, ...]) -> Array:
    """Returns x - goal [2 d], with angles wrapped to the shorter way round."""
    off = x - jnp.asarray(goal)
    round_ = np.concatenate([np.array(joints) == "revolute", np.zeros(len(joints), bool)])
    return jnp.where(round_, jnp.arctan2(jnp.sin(off), jnp.cos(off)), off)


def regulated(regulator: Regulator, goal: Any, controls: Any, joints: tuple[JointKind, ...]) -> Law:
    """u = u0 - K (x - x0)."""
    return lambda x: where_finite(jnp.asarray(controls) - regulator.K @ error(x, goal, joints), x)


def value(regulator: Regulator, goal: Any, joints: tuple[JointKind, ...]) -> Callable[[Array], Scalar]:
    """x -> (x - x0)ᵀ S (x - x0)."""

    def cost(x: Array) -> Scalar:
        off = error(x, goal, joints)
        return off @ regulator.S @ off

    return cost


def switched(far: Law, near: Law, cost: Callable[[Array], Scalar], level: Any) -> Law:
    """Switches to `near` where the cost to go is at most the level; `far` elsewhere."""

    def law(x: Array) -> Array:
        inside = cost(x) <= level
        # Both are evaluated, and the one that does not apply may be NaN.
        return where_finite(jnp.where(inside, near(x), far(x)), x)

    return law


def region_of_attraction(
    field: Field,
    law: Law,
    regulator: Regulator,
    goal: Any,
    joints: tuple[JointKind, ...],
    *,
    least: Any = -jnp.inf,
    most: Any = jnp.inf,
    rate: float = 500.0,
    seconds: float = 5.0,
    levels: Any = None,
    starts: int = 64,
    key: Array | None = None,
) -> Region:
    """Returns the largest level below which all random starts on the level's surface reach the goal in simulation.

    Args:
        field: of the plant.
        law: near the goal.
        regulator: its S shapes the region.
        goal: x0 [2 d].
        joints: kinds.
        least: lower limits of the controls.
        most: upper limits of the controls.
        rate: of the samples, Hz.
        seconds: time within which the cost has to fall to a hundredth of the level.
        levels: ascending; by default powers of ten of 10⁻³ to 10³ times the trace of S, five to a decade.
        starts: number of starts on every surface.
        key: of the starts.
    """
    require_positive(starts=starts, rate=rate, seconds=seconds)
    n = regulator.S.shape[0]
    controls = regulator.K.shape[0]
    levels = np.asarray(np.trace(regulator.S) * 10 ** np.arange(-3, 3.01, 0.2) if levels is None else levels, float)
    sizes, axes = np.linalg.eigh(np.asarray(regulator.S))
    drawn = jax.random.normal(jax.random.key(0) if key is None else key, (starts, n))
    sphere = drawn / jnp.linalg.norm(drawn, axis=1, keepdims=True)
    surface = (sphere / np.sqrt(sizes)) @ axes.T
    cost = value(regulator, goal, joints)
    controller = Controller((), lambda memory, t, y: (memory, law(y)))
    lab = Hardware(least, most)

    @jax.jit
    def arrives(level: Array) -> Bool[Array, " starts"]:
        def one(start: Array) -> Array:
            run = simulate(
                field, controller, jnp.asarray(goal) + jnp.sqrt(level) * start,
                seconds=seconds, rate=rate, controls=controls, hardware=lab,
            )  # fmt: skip
            return cost(run.x[-1]) <= 0.01 * level

        return jax.vmap(one)(surface)

    kept = Region(0.0, 1.0)
    for level in levels:
        share = float(jnp.mean(arrives(jnp.asarray(level))))
        if share < 1:
            break
        kept = Region(float(level), share)
    return kept
