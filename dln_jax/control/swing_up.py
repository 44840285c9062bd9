"""Swing-ups by energy: a complete law, or a controller with an estimator, from a known or learned model.

`swing_up` makes a complete law from a model:

1. The model's friction is removed: the rest has an energy and a smooth linearisation.
2. The model's own equilibrium near the goal is computed, because a learned potential is not level exactly at the goal.
3. Far from it the energy law acts, near it the regulator of the linearisation; the regulator's cost to go decides.
4. A share of the friction of the active joints is compensated, at the measured rates.
5. At rest the energy law returns zero and dry friction would hold the plant, so a kick starts it.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.control.closed_loop import Controller, stateless
from dln_jax.control.energy_shaping import EnergyGains, Parts, energy_shaping, parts_of, with_energy
from dln_jax.control.regulators import Regulator, lqr, regulated, switched, value
from dln_jax.control.state_space import Law, Linearisation, field_of, holding_controls, linearise
from dln_jax.control.tracking import GAIN, definite, friction_compensation, without_friction
from dln_jax.mechanics.dynamics import Dynamics, InverseForward
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
    """Largest cost to go at which the regulator acts."""
    smoothing: Any
    """Smoothing of the friction compensation, rad/s or m/s."""
    compensation: float = GAIN
    """Share of the active joints' friction that is compensated; 0 for none."""
    kick: float = 0.0
    """Kick in N m or N on a plant at rest far from the goal, towards the active joints' goal."""
    still: float = 0.05
    """Largest measured rate that counts as rest, 1/s or m/s."""
    surplus: Any = 0.0
    """Target energy above that of the goal, J, which compensates losses of the passive joints."""


class SwingUp(NamedTuple):
    """A swing-up law with its equilibrium and regulator."""

    law: Law
    controller: Controller
    """Controller of measurements, by the estimator; without one, of states."""
    equilibrium: Float[Array, " two_d"]
    """The model's own equilibrium near the goal."""
    controls: Float[Array, " m"]
    """Controls that hold it."""
    regulator: Regulator

    @property
    def offset(self) -> float:
        """Largest coordinate of the equilibrium, rad or m, for a goal at zero."""
        return float(jnp.max(jnp.abs(self.equilibrium)))


class Upright(NamedTuple):
    """A checked model with its own equilibrium near the goal, as a swing-up needs them."""

    model: Dynamics
    """With friction, if it has any."""
    parts: Parts
    B: Float[np.ndarray, "d m"]
    at: Linearisation
    """Linearisation at the equilibrium, without friction."""


def nearest_equilibrium(plant: Dynamics, goal: Any, passive: Sequence[int]) -> Vector:
    """Returns the posture [d] near a goal with zero force at the passive joints, by Newton's method over these.

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


def swing_up(
    model: Dynamics | InverseForward,
    actuation: Any,
    joints: tuple[JointKind, ...],
    goal: Any,
    numbers: SwingUpNumbers,
    *,
    postures: Any,
    estimator: Callable[[Law], Controller] = stateless,
    lower: Any = -jnp.inf,
    upper: Any = jnp.inf,
    tolerance: float = 1e-6,
) -> SwingUp:
    """Returns the law x -> u of a swing-up by a model, and its controller of measurements.

    Args:
        model: known or learned, with friction or without.
        actuation: matrix [d, m]; every motor drives one coordinate.
        joints: kinds of the joints.
        goal: posture [d].
        numbers: gains and costs.
        postures: [n, d], postures of a swing-up; the model must be usable in all of them.
        estimator: law -> controller of measurements, such as `plants.by_filter`; by default states are measured.
        lower: lower limits of the controls.
        upper: upper limits of the controls.
        tolerance: largest remaining torque at the equilibrium, N m or N.

    Raises:
        InputError: the model has no energy, no definite mass matrix or no equilibrium near the goal; or the limits
            cannot hold the equilibrium, or no feedback stabilises it.
    """
    upright = upright_of(
        model, actuation, goal, postures=postures, lower=lower, upper=upper, tolerance=tolerance
    )  # fmt: skip
    with jax.ensure_compile_time_eval():
        regulator = lqr(upright.at.A, upright.at.B, numbers.state_cost, numbers.control_cost)
    law = law_at(upright, joints, numbers, regulator)
    return SwingUp(law, estimator(law), upright.at.x, upright.at.u, regulator)


def upright_of(
    model: Dynamics | InverseForward,
    actuation: Any,
    goal: Any,
    *,
    postures: Any,
    lower: Any = -jnp.inf,
    upper: Any = jnp.inf,
    tolerance: float = 1e-6,
) -> Upright:
    """Checks a model and computes its equilibrium near the goal; arguments and errors as for `swing_up`."""
    parts, B = parts_of(actuation), np.asarray(actuation, float)
    # Values that depend on the model only are computed now, even if gains or the level are being traced.
    with jax.ensure_compile_time_eval():
        model = with_energy(model)
        sound = np.asarray(jax.jit(jax.vmap(lambda q: definite(model, q)))(jnp.asarray(postures, float)))
        if not sound.all():
            raise InputError(
                f"the model's mass matrix is not positive definite in {np.mean(~sound):.1%} of the postures that a "
                "swing-up goes through; learn a model that is by construction, such as a structured DeLaN, or use more "
                "motions"
            )
        conservative = without_friction(model)
        # Compiled, because they take longer operation by operation.
        inverse, forward = jax.jit(conservative.inverse_dynamics), jax.jit(conservative.forward_dynamics)
        whole = conservative._replace(inverse_dynamics=inverse, forward_dynamics=forward)
        home = nearest_equilibrium(whole, goal, parts.passive)
        controls = holding_controls(whole, home, B, tolerance=tolerance)
        if not bool(jnp.all((controls > lower) & (controls < upper))):
            raise InputError(
                f"the limits {lower} to {upper} do not hold the goal, which takes {np.round(controls, 4).tolist()}; "
                "choose another goal, or a stronger motor"
            )
        x = jnp.concatenate([home, jnp.zeros_like(home)])
        return Upright(model, parts, B, linearise(field_of(whole, B), x, controls, tolerance=np.inf))


def law_at(upright: Upright, joints: tuple[JointKind, ...], numbers: SwingUpNumbers, regulator: Regulator) -> Law:
    """Returns the law x -> u of a swing-up to an equilibrium; gains, level, kick and regulator may be traced."""
    parts, (home, _) = upright.parts, jnp.split(upright.at.x, 2)
    # Motors are ordered by columns of the matrix, active joints by coordinates.
    to_controls = jnp.linalg.pinv(upright.B[np.array(parts.active)])
    shaped = energy_shaping(
        without_friction(upright.model), parts, home, numbers.gains, surplus=numbers.surplus
    )  # fmt: skip
    near = regulated(regulator, upright.at.x, upright.at.u, joints)
    cost = value(regulator, upright.at.x, joints)

    def far(x: Array) -> Array:
        q, qd = jnp.split(x, 2)
        active = np.array(parts.active)
        towards = jnp.where(q[active] > home[active], -numbers.kick, numbers.kick)
        resting = jnp.max(jnp.abs(qd)) <= numbers.still
        return to_controls @ jnp.where(resting, towards, shaped(q, qd))

    law = switched(far, near, cost, numbers.level)
    if numbers.compensation == 0:
        return law
    friction = friction_compensation(
        upright.model, parts.active, smoothing=numbers.smoothing, gain=numbers.compensation
    )  # fmt: skip
    return lambda x: law(x) + to_controls @ friction(*jnp.split(x, 2))
