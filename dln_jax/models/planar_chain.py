"""Chain of links in one plane with unknown lengths, masses and inertias, on a fixed base, a slide or several.

With the links' absolute angles phi, measured from hanging straight down,

    T = ½ sum_ij (A_ij cos(phi_i - phi_j) + B_ij sin(phi_i - phi_j)) phid_i phid_j + ½ sum_i a_i w_i²
    V = -sum_i (g_i cos phi_i + h_i sin phi_i)
    D = sum_i ½ b_i w_i² + c_i v log cosh(w_i / v),   w_i = phid_i - phid_{i-1}, the joint's rate

A is symmetric and B skew. B and h vanish if the centres of mass lie on the lines between joints and the zeros of the
angles are right; the armature a_1 of the first motor is part of A_11. All parameters enter linearly
(`learning.linear.fit_linear`) and are identifiable from motions ("base parameters"): for a double pendulum, g_2 / A_12
is the acceleration of gravity divided by the first link's length. Friction acts in the joints, for any coordinates.

Slides, which come before all hinges, have phi = 0: A_ij and B_ij of a slide and a link are the components of a mass
times a length along the slide. Their phid in T is the rate of the displacement x, and V has g_i x²/2 - h_i x, a spring
and the weight along the slide, in place of their other terms.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike

from dln_jax.mechanics.closed_form import ClosedForm
from dln_jax.mechanics.friction.curves import joint_dissipation
from dln_jax.models.model import Model
from dln_jax.types import InputError, Matrix, Needs, Scalar, Vector, require_positive


class PlanarChainParameters(NamedTuple):
    """Parameters of d links; `None` for terms that are left out."""

    moments: Any
    """A: its lower triangle, row by row [d (d + 1) / 2], kg m², kg m or kg."""
    skew: Any
    """B: below its diagonal, row by row [d (d - 1) / 2], kg m², kg m or kg."""
    armature: Any
    """a of the hinges after the first, kg m²."""
    weight: Any
    """g [d], N m, or N/m of a slide."""
    sideways: Any
    """h [d], N m or N."""
    viscous: Any
    """b [d], N m s or N s/m."""
    coulomb: Any
    """c [d], N m or N."""


def make_planar_chain(
    needs: Needs,
    *,
    coordinates: str = "relative",
    directions: tuple[int, ...] | None = None,
    symmetric: bool = True,
    armature: bool = False,
    velocity_scale: float = 0.05,
    dtype: DTypeLike = jnp.float64,
) -> Model:
    """Returns the (init, energies) pair of a planar chain; `init` ignores its key: M_ii = 1, all else is zero.

    Args:
        needs: prismatic joints come first; friction adds viscous and dry friction in all joints.
        coordinates: "relative" or "absolute": q_i is the angle of link i from the previous link, or from the vertical.
        directions: 1 or -1 for every joint: -1 if its axis points against that of the first (default: all 1).
        symmetric: whether B and h are left out.
        armature: whether the hinges after the first have armature (the inertia of motors or gears).
        velocity_scale: velocity scale of dry friction, rad/s, as in `FrictionShape`; it is not fitted.

    Raises:
        InputError: a slide comes after a hinge, the coordinates are unknown, a direction is neither 1 nor -1, or a
            scale is not positive.
    """
    require_positive(velocity_scale=velocity_scale)
    d = needs.degrees_of_freedom
    hinge = np.array([joint == "revolute" for joint in needs.joints])
    if (np.diff(hinge.astype(int)) < 0).any():
        raise InputError(f"the joints are {needs.joints}; a planar chain has slides before hinges: take another model")
    if coordinates not in ("relative", "absolute"):
        raise InputError(f"coordinates are {coordinates!r}; expected 'relative' or 'absolute'")
    signs = np.ones(d) if directions is None else np.asarray(directions)
    if signs.shape != (d,) or not (np.abs(signs) == 1).all():
        raise InputError(f"directions are {directions}; expected 1 or -1 for each of the {d} joints")
    # phi and displacements = absolute q, and rates of the joints w = relative qd.
    sums = np.where(hinge[:, None] & hinge, np.tril(np.ones((d, d))), np.eye(d))
    absolute: Any = (sums if coordinates == "relative" else np.eye(d)) * signs
    relative: Any = np.linalg.inv(sums) @ absolute
    turning: Any = hinge[:, None] * absolute
    geared = np.flatnonzero(hinge)[1:]
    triangle, below = np.tril_indices(d), np.tril_indices(d, -1)

    def init(key: Array) -> PlanarChainParameters:
        def zeros(count: int, wanted: bool) -> Array | None:
            return jnp.zeros(count, dtype) if wanted else None

        return PlanarChainParameters(
            moments=jnp.asarray((triangle[0] == triangle[1]).astype(float), dtype),
            skew=zeros(len(below[0]), not symmetric),
            armature=zeros(len(geared), armature),
            weight=zeros(d, needs.gravity),
            sideways=zeros(d, needs.gravity and not symmetric),
            viscous=zeros(d, needs.friction),
            coulomb=zeros(d, needs.friction),
        )

    def energies(parameters: PlanarChainParameters) -> ClosedForm:
        moments, skew, motors, weight, sideways, viscous, coulomb = parameters
        like = jnp.zeros((d, d), moments.dtype)
        A = like.at[triangle].set(moments)
        A = A + A.T - jnp.diag(jnp.diagonal(A))
        B = None if skew is None else like.at[below].set(skew) - like.at[below].set(skew).T
        fixed = 0.0 if motors is None else relative.T @ jnp.diag(jnp.zeros(d).at[geared].set(motors)) @ relative

        def mass_matrix(q: Vector) -> Matrix:
            between = _between(turning @ q)
            own = A * jnp.cos(between) + (0.0 if B is None else B * jnp.sin(between))
            return absolute.T @ own @ absolute + fixed

        def coriolis(q: Vector, qd: Vector) -> Vector:
            between = _between(turning @ q)
            slopes = A * jnp.sin(between) - (0.0 if B is None else B * jnp.cos(between))
            return absolute.T @ (slopes @ (turning @ qd) ** 2)

        def potential(q: Vector) -> Scalar:
            place = absolute @ q
            height = weight @ jnp.where(hinge, jnp.cos(place), -(place**2) / 2)
            return -height if sideways is None else -height - sideways @ jnp.where(hinge, jnp.sin(place), place)

        dissipation = None
        if viscous is not None:
            dissipation = joint_dissipation(viscous, coulomb, velocity_scale=velocity_scale, joint_map=relative)
        return ClosedForm(
            mass_matrix=mass_matrix,
            coriolis=coriolis,
            potential=None if weight is None else potential,
            gravity=None if weight is None else jax.grad(potential),
            dissipation=dissipation,
            friction=None if dissipation is None else jax.grad(dissipation, argnums=1),
        )

    return Model(init, energies)


def _between(phi: Vector) -> Matrix:
    return phi[:, None] - phi[None, :]
