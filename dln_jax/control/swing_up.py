"""Swing-ups by energy, from a known or learned model, with gains and costs from the model's natural scales.

1. The model's friction is removed; the remaining system has an energy and a smooth linearisation.
2. The model's own equilibrium near the goal is computed, because a learned potential is not exactly level at the goal.
3. Far from it the energy law acts; near it the regulator of the linearisation acts. The regulator's cost to go decides.
4. A share of the friction of the active joints is compensated, at the measured rates.
5. At rest the energy law returns zero, and dry friction would hold the plant. A kick starts it.

With the active joints locked at the goal, the passive part falls from the goal at a rate lambda. It needs the energy E
from its lowest to its highest posture, and swings at the speed w = √(2 E / M_pp) at most. Motors at their limits
accelerate the active joints by a. Then

    k_energy = energy · a / (E |M_ap| w),   k_p = (stiffness · lambda)²,   k_d = 2 damping · stiffness · lambda
    Q = diag(1 / s², (rates / (s lambda))²),   R = effort / u²,   level = (catch · u)² / max(K S⁻¹ Kᵀ)

with the limits u of the controls (in `level`, minus the holding controls), and errors s of equal cost: `PASSIVE` for
passive angles, `reach` for an active angle in rad, and for a rail `reach` times the smaller of g / lambda² and half the
rail. On the surface of the catch region the regulator uses at most the share `catch` of the motors' reserve. The energy
law aims `surplus` E above the goal, because friction takes energy on the way up.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control.energy_shaping import EnergyGains, Parts, energy_shaping, parts_of, passive_energy, with_energy
from dln_jax.control.plants.plant import Layout
from dln_jax.control.regulators import Regulator, lqr, regulated, switched, value
from dln_jax.control.state_space import Law, Linearisation, field_of, holding_controls, linearise
from dln_jax.control.tracking import GAIN, definite, friction_compensation, without_friction
from dln_jax.mechanics.dynamics import Dynamics, InverseForward
from dln_jax.types import InputError, Vector

NEWTON_STEPS = 20
FARTHEST = 0.1
"""Largest distance of a model's equilibrium from the goal, rad or m."""
LEVEL = 1e-6
"""Largest remaining torque at the equilibrium, N m or N."""
STILL = 0.05
"""Largest measured rate at rest, 1/s or m/s."""
PASSIVE = 0.2
"""Error of a passive angle in Q, rad."""
CIRCLE = 65
"""Postures of a full turn."""
RANGES: Mapping[str, tuple[float, float]] = {
    "energy": (1.0, 20.0),
    "stiffness": (0.2, 1.0),
    "damping": (0.3, 1.5),
    "reach": (0.15, 3.0),
    "rates": (0.3, 4.0),
    "effort": (2.0, 300.0),
    "catch": (0.5, 6.0),
    "kick": (0.3, 1.0),
    "surplus": (0.01, 0.5),
}
"""Range of every number; draws are uniform in the logarithm."""
USUAL = {name: float(np.sqrt(low * high)) for name, (low, high) in RANGES.items()}
SMOOTHING = 0.05
"""Smoothing of the friction compensation, as a share of lambda times the size of a coordinate."""


class Scales(NamedTuple):
    """Natural scales of a plant."""

    fall: float
    """lambda, 1/s."""
    energy: float
    """E, J."""
    speed: float
    """w, 1/s."""
    coupling: float
    """|M_ap| at the goal, kg m² or kg m."""
    acceleration: float
    """a, 1/s² or m/s²."""
    sizes: np.ndarray
    """Size of every coordinate [d]: 1 rad, and for a rail g / lambda² or half of the rail."""


class Upright(NamedTuple):
    """A checked model of a plant with its own equilibrium near the goal, and its scales."""

    model: Dynamics
    """The model with its friction."""
    layout: Layout
    parts: Parts
    at: Linearisation
    """Linearisation at the equilibrium, without friction."""
    scales: Scales

    @property
    def forces(self) -> np.ndarray:
        """Largest forces of the motors to either side [m], N m or N."""
        return np.abs(self.layout.limits.control).min(axis=1)

    @property
    def rest(self) -> np.ndarray:
        """State [2 d] of the plant that hangs at rest."""
        return np.concatenate([self.layout.hanging, np.zeros(len(self.layout.joints))])

    def controls(self, forces: Array) -> Array:
        """Returns the controls [m] for forces of the active joints, in the order of the motors."""
        return jnp.asarray(np.linalg.pinv(self.layout.actuation[np.array(self.parts.active)])) @ forces


class SwingUpNumbers(NamedTuple):
    """Settings of a swing-up, in SI units; all may be traced."""

    gains: EnergyGains
    state_cost: Any
    """Q [2 d, 2 d] of the regulator."""
    control_cost: Any
    """R [m, m]."""
    regulator: Regulator
    level: Any
    """Largest cost to go at which the regulator acts."""
    kick: Any
    """Kick in N m or N on a plant at rest far from the goal, towards the active joints' goal."""
    surplus: Any
    """Target energy above the goal, J, to compensate losses of the passive joints."""


def nearest_equilibrium(plant: Dynamics, goal: Any, passive: Sequence[int]) -> Vector:
    """Returns the posture [d] near a goal with zero force at the passive joints, by Newton's method.

    Raises:
        InputError: there is no equilibrium within `FARTHEST`.
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
            "m; train the model on motions near the goal"
        )
    return goal.at[free].set(angles)


def upright_of(model: Dynamics | InverseForward, layout: Layout) -> Upright:
    """Checks a model of a plant, and computes its equilibrium near the goal and its scales.

    Raises:
        InputError: the model has no energy, no definite mass matrix or no equilibrium near the goal; the limits cannot
            hold the equilibrium; or the passive joints do not fall from it.
    """
    parts, (lower, upper) = parts_of(layout.actuation), layout.limits.control.T
    model = with_energy(model)
    sound = np.asarray(jax.jit(jax.vmap(lambda q: definite(model, q)))(circle(layout)))
    if not sound.all():
        raise InputError(
            f"the model's mass matrix is not positive definite in {np.mean(~sound):.1%} of the postures of a "
            "swing-up; train a model with a definite mass matrix, such as a structured DeLaN, or use more "
            "motions"
        )
    conservative = without_friction(model)
    # Compiled, because single operations would take longer.
    inverse, forward = jax.jit(conservative.inverse_dynamics), jax.jit(conservative.forward_dynamics)
    whole = conservative._replace(inverse_dynamics=inverse, forward_dynamics=forward)
    home = nearest_equilibrium(whole, layout.goal, parts.passive)
    controls = holding_controls(whole, home, layout.actuation, tolerance=LEVEL)
    if not bool(jnp.all((controls > lower) & (controls < upper))):
        raise InputError(
            f"holding the goal takes {np.round(controls, 4).tolist()}, outside the limits {lower} to {upper}; "
            "choose another goal, or a stronger motor"
        )
    x = jnp.concatenate([home, jnp.zeros_like(home)])
    at = linearise(field_of(whole, layout.actuation), x, controls, tolerance=np.inf)
    return Upright(model, layout, parts, at, _scales(conservative, layout, parts, home))


def circle(layout: Layout) -> np.ndarray:
    """Returns postures [n, d] with the passive joints turned together and the active joints at the goal or hanging."""
    angle = np.linspace(-np.pi, np.pi, CIRCLE)[:, None]
    passive = 1.0 - (layout.actuation != 0).any(axis=1)
    rest = np.where(passive > 0, layout.goal, layout.hanging)
    return np.concatenate([layout.goal + angle * passive, rest + angle * passive])


def _scales(model: Dynamics, layout: Layout, parts: Parts, home: Array) -> Scales:
    """Returns the scales of a model without friction."""
    active, passive = map(np.array, parts)
    rest = jnp.zeros_like(home)
    M = np.asarray(jax.jit(model.mass_matrix)(home))
    weight = jax.jit(jax.jacfwd(lambda q: model.inverse_dynamics(q, rest, rest)))(home)
    pull = np.asarray(weight)[np.ix_(passive, passive)]
    stiffness = max(np.linalg.eigvals(-np.linalg.solve(M[np.ix_(passive, passive)], pull)).real)
    fall = float(np.sqrt(max(stiffness, 0.0)))
    energies = jax.jit(jax.vmap(lambda q: passive_energy(model, parts, home)(q, rest)))(circle(layout))
    energy = -float(np.min(energies))
    if not (fall > 0 and energy > 0):
        raise InputError("the passive joints do not fall from the goal; expected an upright goal")
    largest = np.abs(layout.limits.control).min(axis=1)
    mobility = np.linalg.solve(M, layout.actuation)[active]
    acceleration = float(np.min(np.abs(np.diag(mobility)) * largest))
    coupling = float(np.linalg.norm(M[np.ix_(active, passive)]))
    half = np.diff(layout.limits.position, axis=1)[:, 0] / 2
    slides = np.array([kind == "prismatic" for kind in layout.joints])
    sizes = np.where(slides, np.minimum(9.81 / fall**2, half), 1.0)
    speed = float(np.sqrt(2 * energy / np.max(np.diag(M)[passive])))
    return Scales(fall, energy, speed, coupling, acceleration, sizes)


def swing_up_numbers(upright: Upright, numbers: Mapping[str, float]) -> SwingUpNumbers:
    """Returns the settings of a swing-up from dimensionless numbers, optionally with "total"; raises as `lqr`."""
    active, passive = map(np.array, upright.parts)
    scales, largest = upright.scales, upright.forces
    size = np.copy(scales.sizes)
    size[active] *= numbers["reach"]
    size[passive] = PASSIVE
    Q = np.diag(np.concatenate([1 / size, numbers["rates"] / (size * scales.fall)]) ** 2)
    R = np.diag(numbers["effort"] / largest**2)
    regulator = lqr(upright.at.A, upright.at.B, Q, R)
    K, S = map(np.asarray, regulator)
    spare = largest - np.abs(np.asarray(upright.at.u))
    level = float(np.min((numbers["catch"] * spare) ** 2 / np.diag(K @ np.linalg.solve(S, K.T))))
    stiffness = numbers["stiffness"] * scales.fall
    unit = scales.acceleration / (scales.energy * scales.coupling * scales.speed)
    damping = 2 * numbers["damping"] * stiffness
    gains = EnergyGains(numbers["energy"] * unit, stiffness**2, damping, numbers.get("total"))
    kick, surplus = numbers["kick"] * float(largest.min()), numbers["surplus"] * scales.energy
    return SwingUpNumbers(gains, Q, R, regulator, level, kick, surplus)


def law_of(upright: Upright, numbers: SwingUpNumbers) -> Law:
    """Returns the law x -> u of a swing-up to the equilibrium."""
    home = upright.at.x[: len(upright.layout.joints)]
    active, joints = np.array(upright.parts.active), upright.layout.joints
    shaped = energy_shaping(
        without_friction(upright.model), upright.parts, home, numbers.gains, surplus=numbers.surplus
    )  # fmt: skip

    def far(x: Array) -> Array:
        q, qd = jnp.split(x, 2)
        towards = jnp.where(q[active] > home[active], -numbers.kick, numbers.kick)
        return upright.controls(jnp.where(jnp.max(jnp.abs(qd)) <= STILL, towards, shaped(q, qd)))

    near = regulated(numbers.regulator, upright.at.x, upright.at.u, joints)
    law = switched(far, near, value(numbers.regulator, upright.at.x, joints), numbers.level)
    friction = friction_of(upright)
    return lambda x: law(x) + friction(x)


def friction_of(upright: Upright) -> Law:
    """Returns x -> controls that compensate most of the friction of the active joints; zero without friction."""
    active, scales = np.array(upright.parts.active), upright.scales
    with jax.ensure_compile_time_eval():  # also while a law is traced
        moving = jnp.ones(len(upright.layout.joints))
        present = bool(jnp.any(upright.model.friction(jnp.zeros_like(moving), moving)[active] != 0))
    if not present:
        return lambda x: jnp.zeros_like(upright.at.u)
    smoothing = SMOOTHING * scales.fall * scales.sizes[active]
    forces = friction_compensation(upright.model, upright.parts.active, smoothing=smoothing, gain=GAIN)
    return lambda x: upright.controls(forces(*jnp.split(x, 2)))
