"""Swing-up of plants with passive joints by energy, with a known or learned model: the same functions for all models.

Collocated partial feedback linearisation gives the active joints any acceleration a (Spong 1995, "The swing up control
problem for the acrobot"). The passive rows of the equations of motion, without motors, determine the other
accelerations. With h = c + g + friction,

    qdd_p = -M_pp⁻¹ (M_pa a + h_p),   tau_a = M_aa a + M_ap qdd_p + h_a

The passive part, with the active joints locked, has the energy E = ½ qd_pᵀ M_pp qd_p + V. Accelerating the active
joints does work on it at the rate -qd_pᵀ M_pa a, so that a = k (E - E*) M_ap qd_p drives E to that of the goal.

`swing_up` makes a whole law from a model:

1. The model's friction is removed: the rest has energies, and a smooth linearisation.
2. The model's own equilibrium near the goal is computed, because a learned potential is not level exactly at the goal.
3. Far from it the energy law acts, near it the regulator of the model's linearisation; the regulator's value decides.
4. A share of the friction of the active joints is compensated, at the measured rates.
5. At rest the energy law returns zero, and dry friction would hold the plant: a kick starts it.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.control.regulators import Regulator, lqr, regulated, switched, value
from dln_jax.control.state_space import Law, Linearisation, field_of, holding_controls, linearise, where_finite
from dln_jax.control.tracking import GAIN, definite, friction_compensation, without_friction
from dln_jax.mechanics.dynamics import Dynamics, PlainDynamics
from dln_jax.solvers.elimination import solve
from dln_jax.types import InputError, JointKind, Scalar, Vector

NEWTON_STEPS = 20
FARTHEST = 0.1
"""Largest distance of a model's equilibrium from the goal, rad or m."""


class EnergyGains(NamedTuple):
    """Gains of the accelerations of the active joints."""

    energy: float
    """1/(kg m² J s) for revolute joints; maps M_ap qd_p times the energy's error to an acceleration."""
    proportional: float
    """1/s²."""
    derivative: float
    """1/s."""
    total: Any = None
    """Whether the energy is that of the whole plant, as for acrobots (Spong), and the coupling that of the goal; 0 or
    1, possibly traced. `None`: the energy of the passive part, as for poles on a driven base."""


class Parts(NamedTuple):
    """Indices of the driven and of the passive coordinates."""

    active: tuple[int, ...]
    passive: tuple[int, ...]


def parts_of(actuation: Any) -> Parts:
    """Derives the parts from the matrix [d, u] in tau = B u, if every motor drives one coordinate.

    Raises:
        InputError: motors that drive several coordinates, or no passive one.
    """
    B = np.asarray(actuation, float)
    driven = (B != 0).sum(axis=1)
    active = tuple(np.flatnonzero(driven).tolist())
    if B.ndim != 2 or (driven > 1).any() or ((B != 0).sum(axis=0) != 1).any() or len(active) == len(B):
        raise InputError(
            f"actuation is {B.tolist()}; expected motors that drive one coordinate each, and some coordinate without"
        )
    return Parts(active, tuple(np.setdiff1d(np.arange(len(B)), active).tolist()))


def partial_linearisation(plant: Dynamics, parts: Parts) -> Callable[[Vector, Vector, Array], Array]:
    """(q, qd, accelerations of the active joints) -> their forces, exact where M_pp is regular."""
    active, passive = map(np.array, parts)

    def forces(q: Vector, qd: Vector, a: Array) -> Array:
        M = plant.mass_matrix(q)
        h = plant.inverse_dynamics(q, qd, jnp.zeros_like(qd))
        coupling = M[np.ix_(active, passive)]
        others = -solve(M[np.ix_(passive, passive)], coupling.T @ a + h[passive])
        return where_finite(M[np.ix_(active, active)] @ a + coupling @ others + h[active], q, qd)

    return forces


def passive_energy(plant: Dynamics, parts: Parts, goal: Any) -> Callable[[Vector, Vector], Scalar]:
    """(q, qd) -> energy of the passive part in J, with the active joints locked at the goal, relative to the goal."""
    active, passive = map(np.array, parts)
    goal = jnp.asarray(goal, float)

    def energy(q: Vector, qd: Vector) -> Scalar:
        held = q.at[active].set(goal[active])
        moving = jnp.zeros_like(qd).at[passive].set(qd[passive])
        return plant.energy(held, moving) - plant.energy(goal, jnp.zeros_like(qd))

    return energy


def energy_shaping(
    plant: Dynamics | PlainDynamics,
    parts: Parts,
    goal: Sequence[float] | Array,
    gains: EnergyGains,
    *,
    surplus: Any = 0.0,
) -> Callable[[Vector, Vector], Array]:
    """(q, qd) -> forces that bring the passive joints to the goal's energy, and the active joints to the goal.

    Args:
        plant: a known or learned model with energies; its friction is compensated at the active joints.
        parts: driven and passive joints.
        goal: posture [d].
        gains: of the accelerations.
        surplus: target energy of the passive joints above that of the goal, J, which compensates their losses.

    Raises:
        InputError: a model without energies.
    """
    plant, (active, passive) = _with_energy(plant), map(np.array, parts)
    forces, energy = partial_linearisation(plant, parts), passive_energy(plant, parts, goal)
    goal = jnp.asarray(goal, float)
    home = goal[active]

    def law(q: Vector, qd: Vector) -> Array:
        coupling, error = plant.mass_matrix(q)[np.ix_(active, passive)], energy(q, qd) - surplus
        if gains.total is not None:
            whole = plant.energy(q, qd) - plant.energy(goal, jnp.zeros_like(qd)) - surplus
            at_goal = plant.mass_matrix(goal)[np.ix_(active, passive)]
            coupling, error = jnp.where(gains.total, at_goal, coupling), jnp.where(gains.total, whole, error)
        pumping = gains.energy * error * (coupling @ qd[passive])
        a = pumping - gains.proportional * (q[active] - home) - gains.derivative * qd[active]
        return forces(q, qd, a)

    return law


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
    surplus: Any = 0.0
    """Target energy above that of the goal, J, which compensates losses of the passive joints."""


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


class Upright(NamedTuple):
    """A checked model with its own equilibrium near the goal, and what a swing-up needs of both."""

    model: Dynamics
    """With friction, if it has any."""
    parts: Parts
    B: Float[np.ndarray, "d m"]
    at: Linearisation
    """At the equilibrium, without friction."""


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


def swing_up(
    model: Dynamics | PlainDynamics,
    actuation: Any,
    joints: tuple[JointKind, ...],
    goal: Any,
    numbers: SwingUpNumbers,
    *,
    postures: Any,
    lower: Any = -jnp.inf,
    upper: Any = jnp.inf,
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
        lower: lower limits of the controls.
        upper: upper limits of the controls.
        tolerance: of the equilibrium, in N m or N.

    Raises:
        InputError: a model without energies, with a mass matrix that is not definite, without an equilibrium near the
            goal, or with one that the limits cannot hold or no feedback stabilises.
    """
    upright = upright_of(
        model, actuation, goal, postures=postures, lower=lower, upper=upper, tolerance=tolerance
    )  # fmt: skip
    with jax.ensure_compile_time_eval():
        regulator = lqr(upright.at.A, upright.at.B, numbers.state_cost, numbers.control_cost)
    return SwingUp(law_at(upright, joints, numbers, regulator), upright.at.x, upright.at.u, regulator)


def upright_of(
    model: Dynamics | PlainDynamics,
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
        model = _with_energy(model)
        sound = np.asarray(jax.jit(jax.vmap(lambda q: definite(model, q)))(jnp.asarray(postures, float)))
        if not sound.all():
            raise InputError(
                f"the model's mass matrix is not positive definite in {np.mean(~sound):.1%} of the postures that a "
                "swing-up goes through; learn a model that is by construction, such as a structured DeLaN, or use more "
                "motions"
            )
        conservative = without_friction(model)
        # Compiled, because operation by operation they take longer.
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
    """The law x -> u of a swing-up to an equilibrium; gains, level, kick and regulator may be traced."""
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


def _with_energy(model: Dynamics | PlainDynamics) -> Dynamics:
    if not isinstance(model, Dynamics):
        raise InputError("the model has no energy, which an energy law shapes; train one that has, such as a DeLaN")
    return model
