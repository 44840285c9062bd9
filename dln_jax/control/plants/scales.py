"""Natural scales of a swing-up by a model; they turn numbers without units into gains, costs and the catch region.

With the active joints locked at the goal, the passive part falls from the goal at a rate lambda. It needs the energy E
from its lowest to its highest posture, and swings at the speed w = √(2 E / M_pp) at most. Motors at their limits
accelerate the active joints by a. Then

    k_energy = energy · a / (E |M_ap| w),   k_p = (stiffness · lambda)²,   k_d = 2 damping · stiffness · lambda
    Q = diag(1 / s², (rates / (s lambda))²),   R = effort / u²,   level = (catch · u)² / max(K S⁻¹ Kᵀ)

with the limits u of the controls (in `level`, what holding the goal leaves of them), and errors s of equal cost:
`PASSIVE` for passive angles, `reach` for an active angle in rad, and for a rail `reach` times g / lambda² or half the
rail, whichever is shorter. On the surface of the catch region the regulator asks for at most `catch` times what the
motors have to spare. The energy law aims `surplus` E above the goal, because friction takes energy away on the way up.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.control.energy_shaping import EnergyGains, passive_energy
from dln_jax.control.plants.plant import Layout
from dln_jax.control.regulators import Regulator, lqr
from dln_jax.control.swing_up import SwingUpNumbers, Upright
from dln_jax.control.tracking import GAIN, without_friction
from dln_jax.types import InputError

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
"""Range of every number; draws are uniform in its logarithm."""
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


def circle(layout: Layout) -> np.ndarray:
    """Returns postures [n, d] in which the passive joints turn together, with the active at the goal or hanging."""
    angle = np.linspace(-np.pi, np.pi, CIRCLE)[:, None]
    passive = 1.0 - (layout.actuation != 0).any(axis=1)
    rest = np.where(passive > 0, layout.goal, layout.hanging)
    return np.concatenate([layout.goal + angle * passive, rest + angle * passive])


def scales_of(upright: Upright, layout: Layout) -> Scales:
    """Computes the scales; raises `InputError` if the goal is where the passive joints hang."""
    active, passive = map(np.array, upright.parts)
    model = without_friction(upright.model)
    home = np.asarray(jnp.split(upright.at.x, 2)[0])
    rest = jnp.zeros(len(home))
    M = np.asarray(jax.jit(model.mass_matrix)(jnp.asarray(home)))
    weight = jax.jit(jax.jacfwd(lambda q: model.inverse_dynamics(q, rest, rest)))(jnp.asarray(home))
    pull = np.asarray(weight)[np.ix_(passive, passive)]
    stiffness = max(np.linalg.eigvals(-np.linalg.solve(M[np.ix_(passive, passive)], pull)).real)
    fall = float(np.sqrt(max(stiffness, 0.0)))
    energies = jax.jit(jax.vmap(lambda q: passive_energy(model, upright.parts, home)(q, rest)))(circle(layout))
    energy = -float(np.min(energies))
    if not (fall > 0 and energy > 0):
        raise InputError("the passive joints do not fall from the goal; expected a goal where they stand upright")
    largest = np.abs(layout.limits.control).min(axis=1)
    mobility = np.linalg.solve(M, layout.actuation)[active]
    acceleration = float(np.min(np.abs(np.diag(mobility)) * largest))
    coupling = float(np.linalg.norm(M[np.ix_(active, passive)]))
    half = np.diff(layout.limits.position, axis=1)[:, 0] / 2
    slides = np.array([kind == "prismatic" for kind in layout.joints])
    sizes = np.where(slides, np.minimum(9.81 / fall**2, half), 1.0)
    speed = float(np.sqrt(2 * energy / np.max(np.diag(M)[passive])))
    return Scales(fall, energy, speed, coupling, acceleration, sizes)


def gains_of(scales: Scales, numbers: Mapping[str, Any]) -> EnergyGains:
    """Returns the gains of the energy law from the numbers "energy", "stiffness" and "damping", and perhaps "total"."""
    stiffness = numbers["stiffness"] * scales.fall
    unit = scales.acceleration / (scales.energy * scales.coupling * scales.speed)
    gains = EnergyGains(numbers["energy"] * unit, stiffness**2, 2 * numbers["damping"] * stiffness)
    return gains._replace(total=numbers.get("total"))


def swing_up_numbers(
    upright: Upright, layout: Layout, scales: Scales, numbers: Mapping[str, float]
) -> tuple[SwingUpNumbers, Regulator]:
    """Returns the settings of `swing_up` and their regulator, from numbers without units; raises as `lqr`."""
    active, passive = map(np.array, upright.parts)
    size = np.copy(scales.sizes)
    size[active] *= numbers["reach"]
    size[passive] = PASSIVE
    largest = np.abs(layout.limits.control).min(axis=1)
    Q = np.diag(np.concatenate([1 / size, numbers["rates"] / (size * scales.fall)]) ** 2)
    R = np.diag(numbers["effort"] / largest**2)
    regulator = lqr(upright.at.A, upright.at.B, Q, R)
    K, S = map(np.asarray, regulator)
    spare = largest - np.abs(np.asarray(upright.at.u))
    level = float(np.min((numbers["catch"] * spare) ** 2 / np.diag(K @ np.linalg.solve(S, K.T))))
    smoothing = SMOOTHING * scales.fall * scales.sizes[active]
    settings = SwingUpNumbers(
        gains_of(scales, numbers), Q, R, level, smoothing, kick=numbers["kick"] * float(largest.min()),
        surplus=numbers["surplus"] * scales.energy,
        compensation=GAIN if has_friction(upright) else 0.0,
    )  # fmt: skip
    return settings, regulator


def has_friction(upright: Upright) -> bool:
    """Returns whether the model has friction at the active joints."""
    qd = jnp.ones(len(upright.at.x) // 2)
    return bool(jnp.any(upright.model.friction(jnp.zeros_like(qd), qd)[np.array(upright.parts.active)] != 0))
