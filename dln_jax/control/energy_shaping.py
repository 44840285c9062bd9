"""Energy laws for plants with passive joints, from known or learned models.

Collocated partial feedback linearisation gives the active joints any acceleration a (Spong 1995, "The swing up control
problem for the acrobot"). The passive rows of the equations of motion determine the other accelerations. With h = c + g
+ friction,

    qdd_p = -M_pp⁻¹ (M_pa a + h_p),   tau_a = M_aa a + M_ap qdd_p + h_a

The passive part, with the active joints locked, has the energy E = ½ qd_pᵀ M_pp qd_p + V. Accelerating the active
joints adds power -qd_pᵀ M_pa a, so a = k (E - E*) M_ap qd_p drives E to the energy E* of the goal.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.control.state_space import where_finite
from dln_jax.mechanics.dynamics import Dynamics, InverseForward
from dln_jax.solvers.elimination import solve
from dln_jax.types import InputError, Scalar, Vector


class EnergyGains(NamedTuple):
    """Gains of the accelerations of the active joints."""

    energy: float
    """k, 1/(kg m² J s) for revolute joints: factor from M_ap qd_p times the energy error to an acceleration."""
    proportional: float
    """1/s²."""
    derivative: float
    """1/s."""
    total: Any = None
    """1 for the energy of the whole plant and the coupling at the goal, as for acrobots (Spong); 0 or `None` for the
    energy of the passive part, as for poles on a driven base. The number may be traced."""


class Parts(NamedTuple):
    """Indices of the driven and of the passive coordinates."""

    active: tuple[int, ...]
    passive: tuple[int, ...]


def parts_of(actuation: Any) -> Parts:
    """Derives the parts from the matrix [d, u] in tau = B u, if every motor drives one coordinate.

    Raises:
        InputError: a motor drives several coordinates or none, two motors drive the same one, or none is passive.
    """
    B = np.asarray(actuation, float)
    driven = (B != 0).sum(axis=1)
    active = tuple(np.flatnonzero(driven).tolist())
    if B.ndim != 2 or (driven > 1).any() or ((B != 0).sum(axis=0) != 1).any() or len(active) == len(B):
        raise InputError(
            f"actuation is {B.tolist()}; expected one coordinate per motor, and at least one passive coordinate"
        )
    return Parts(active, tuple(np.setdiff1d(np.arange(len(B)), active).tolist()))


def partial_linearisation(plant: Dynamics, parts: Parts) -> Callable[[Vector, Vector, Array], Array]:
    """Returns (q, qd, accelerations of the active joints) -> their forces, exact where M_pp is regular."""
    active, passive = map(np.array, parts)

    def forces(q: Vector, qd: Vector, a: Array) -> Array:
        M = plant.mass_matrix(q)
        h = plant.inverse_dynamics(q, qd, jnp.zeros_like(qd))
        coupling = M[np.ix_(active, passive)]
        others = -solve(M[np.ix_(passive, passive)], coupling.T @ a + h[passive])
        return where_finite(M[np.ix_(active, active)] @ a + coupling @ others + h[active], q, qd)

    return forces


def passive_energy(plant: Dynamics, parts: Parts, goal: Any) -> Callable[[Vector, Vector], Scalar]:
    """Returns (q, qd) -> energy of the passive part relative to the goal, J, with the active joints locked at the
    goal."""
    active, passive = map(np.array, parts)
    goal = jnp.asarray(goal, float)

    def energy(q: Vector, qd: Vector) -> Scalar:
        held = q.at[active].set(goal[active])
        moving = jnp.zeros_like(qd).at[passive].set(qd[passive])
        return plant.energy(held, moving) - plant.energy(goal, jnp.zeros_like(qd))

    return energy


def energy_shaping(
    plant: Dynamics | InverseForward,
    parts: Parts,
    goal: Sequence[float] | Array,
    gains: EnergyGains,
    *,
    surplus: Any = 0.0,
) -> Callable[[Vector, Vector], Array]:
    """Returns (q, qd) -> forces that drive the passive joints to the goal's energy, and the active joints to the goal.

    Args:
        plant: a known or learned model with energies; its friction is compensated at the active joints.
        parts: driven and passive joints.
        goal: posture [d].
        gains: gains of the accelerations.
        surplus: target energy of the passive joints above the goal, J, to compensate their losses.

    Raises:
        InputError: the model has no energy.
    """
    plant, (active, passive) = with_energy(plant), map(np.array, parts)
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


def with_energy(model: Dynamics | InverseForward) -> Dynamics:
    """Returns the model if it has an energy; raises `InputError` otherwise."""
    if not isinstance(model, Dynamics):
        raise InputError("the model has no energy, but the energy law needs one; train a DeLaN, for example")
    return model
