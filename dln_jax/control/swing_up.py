"""Swing-up of a plant with passive joints by a known or learned model: the same functions for all models.

1. The model's friction is removed (`friction_compensation`): the rest has energies, and a smooth linearisation.
2. The model's own equilibrium near the goal is computed, because a learned potential is not level exactly at the goal.
3. Far from it the energy law acts, near it the regulator of the model's linearisation; the regulator's value decides.
4. A share of the friction of the active joints is compensated, at the measured rates.
5. At rest the energy law returns zero, and dry friction would hold the plant: a kick starts it.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.control.balance import Law, regulated, switched, value
from dln_jax.control.energy_shaping import EnergyGains, energy_shaping, parts_of
from dln_jax.control.friction_compensation import GAIN, friction_compensation, without_friction
from dln_jax.control.quadratic import Regulator, lqr
from dln_jax.control.state_space import field_of, holding_controls, linearise
from dln_jax.control.tracking import definite
from dln_jax.mechanics.dynamics import Dynamics, PlainDynamics
from dln_jax.types import InputError, JointKind, Vector

NEWTON_STEPS = 20
FARTHEST = 0.1
"""Largest distance of a model's equilibrium from the goal, rad or m."""


class SwingUpNumbers(NamedTuple):
    """Settings of a plant's swing-up, the same for all models."""

    gains: EnergyGains
    state_cost: Any
    """Q [2 d, 2 d] of the regulator."""
    control_cost: Any
    """R [m, m]."""
    level: float
    """Level of the regulator's value below which the regulator acts."""
    smoothing: Any
    """Smoothing of the friction compensation, rad/s or m/s."""
    compensation: float = GAIN
    """Share of the active joints' friction that is compensated; 0 for none."""
    kick: float = 0.0
    """Kick in N m or N on a plant at rest far from the goal, towards the active joints' goal."""
    still: float = 0.05
    """Largest measured rate that counts as rest, 1/s or m/s."""


class SwingUp(NamedTuple):
    """A swing-up law with its equilibrium and regulator."""

    law: Law
    equilibrium: Float[Array, " two_d"]
    """The model's own equilibrium near the goal."""
    controls: Float[Array, " m"]
    """Controls that hold it."""
    regulator: Regulator

    @property
    def offset(self) -> float:
        """Largest coordinate of the equilibrium, rad or m, where the goal is zero."""
        return float(jnp.max(jnp.abs(self.equilibrium)))


def nearest_equilibrium(plant: Dynamics, goal: Any, passive: Sequence[int]) -> Vector:
    """Posture [d] nearest to a goal with zero force at the passive joints, by Newton's method over these.

    Raises:
        InputError: there is none within `FARTHEST`.
    """
    goal, free = jnp.asarray(goal, float), np.array(passive)
    rest = jnp.zeros_like(goal)

    def pull(angles: Array) -> Array:
        return plant.inverse_dynamics(goal.at[free].set(angles), rest, rest)[free]

    def step(_: Any, angles: Array) -> Array:
        return angles - jnp.linalg.solve(jax.jacfwd(pull)(angles), pull(angles))

    angles = jax.jit(lambda first: jax.lax.fori_loop(0, NEWTON_STEPS, step, first))(goal[free])
    off = float(jnp.max(jnp.abs(angles - goal[free])))
    if not off <= FARTHEST:
        raise InputError(
            f"the model has no equilibrium near the goal: the nearest is {off:.3g} away, more than {FARTHEST:g} rad or "
            "m; learn it from motions that come near the goal"
        )
    return goal.at[free].set(angles)


def usable(plant: Dynamics | PlainDynamics, postures: Any) -> Dynamics:
    """Returns the model if it is usable.

    Raises:
        InputError: a model without energies, or with a mass matrix that is not definite in some posture [n, d].
    """
    if not isinstance(plant, Dynamics):
        raise InputError("the model has no energy, which an energy law shapes; train one that has, such as a DeLaN")
    fine = np.asarray(jax.jit(jax.vmap(lambda q: definite(plant, q)))(jnp.asarray(postures, float)))
    if not fine.all():
        raise InputError(
            f"the model's mass matrix is not positive definite in {np.mean(~fine):.1%} of the postures that a swing-up "
            "goes through; learn one that is by construction, such as a structured DeLaN, or from more motions"
        )
    return plant


def swing_up(
    model: Dynamics | PlainDynamics,
    actuation: Any,
    joints: tuple[JointKind, ...],
    goal: Any,
    numbers: SwingUpNumbers,
    *,
    postures: Any,
    least: Any = -jnp.inf,
    most: Any = jnp.inf,
    tolerance: float = 1e-6,
) -> SwingUp:
    """Returns the law x -> u of a swing-up by a model.

    Args:
        model: known or learned, with friction or without.
        actuation: matrix [d, m]; every motor drives one coordinate.
        joints: kinds.
        goal: posture [d].
        numbers: gains and costs.
        postures: [n, d], postures of a swing-up, in which the model has to be usable.
        least: lower limits of the controls.
        most: upper limits of the controls.
        tolerance: of the equilibrium, in N m or N.

    Raises:
        InputError: a model without energies, with a mass matrix that is not definite, without an equilibrium near the
            goal, or with one that the limits cannot hold or no feedback stabilises.
    """
    parts, B = parts_of(actuation), np.asarray(actuation, float)
    # Values that depend on the model only are computed now, even if gains or the level are being traced.
    with jax.ensure_compile_time_eval():
        model = usable(model, postures)
        conservative = without_friction(model)
        # Compiled, because operation by operation they take longer.
        inverse, forward = jax.jit(conservative.inverse_dynamics), jax.jit(conservative.forward_dynamics)
        whole = conservative._replace(inverse_dynamics=inverse, forward_dynamics=forward)
        home = nearest_equilibrium(whole, goal, parts.passive)
        controls = holding_controls(whole, home, B, tolerance=tolerance)
        if not bool(jnp.all((controls > least) & (controls < most))):
            raise InputError(
                f"the limits {least} to {most} do not hold the goal, which takes {np.round(controls, 4).tolist()}; "
                "choose another goal, or a stronger motor"
            )
        x = jnp.concatenate([home, jnp.zeros_like(home)])
        at = linearise(field_of(whole, B), x, controls, tolerance=np.inf)
        regulator = lqr(at.A, at.B, numbers.state_cost, numbers.control_cost)
    # Motors are ordered by columns of the matrix, active joints by coordinates.
    to_controls = jnp.linalg.pinv(B[np.array(parts.active)])
    shaped = energy_shaping(conservative, parts, home, numbers.gains)
    near = regulated(regulator, x, controls, joints)
    cost = value(regulator, x, joints)

    def far(x: Array) -> Array:
        q, qd = jnp.split(x, 2)
        active = np.array(parts.active)
        towards = jnp.where(q[active] > home[active], -numbers.kick, numbers.kick)
        resting = jnp.max(jnp.abs(qd)) <= numbers.still
        return to_controls @ jnp.where(resting, towards, shaped(q, qd))

    law = switched(far, near, cost, numbers.level)
    if numbers.compensation == 0:
        return SwingUp(law, x, controls, regulator)
    friction = friction_compensation(model, parts.active, smoothing=numbers.smoothing, gain=numbers.compensation)
    return SwingUp(lambda x: law(x) + to_controls @ friction(*jnp.split(x, 2)), x, controls, regulator)
