"""Variable projection: for given frames, inertias and friction are a linear problem, and drop out.

    tau = Phi(frames) theta,   r = (1 - U Uᵀ) y,   J = -(1 - U Uᵀ) dPhi theta

y are the torques in their units, Phi likewise, U spans its columns. J is Kaufman's (1975) simplification of Golub and
Pereyra's derivative: its gradient Jᵀr is exact, and it needs no derivative of U. The columns are those of a minimal
parametrisation (the others are carried by the link before: Khalil and Dombre 2002, section 9.4), scaled to length one;
the ridge, relative to them, decides where data cannot. Sums over samples only are formed, so that a step takes
milliseconds; `fit` solves the last linear problem with all digits.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from dln_jax.learning.kinematics.frames import Frames, displaced, free_directions
from dln_jax.mechanics.trees.scanned import scanned_forces, scanned_regressor
from dln_jax.types import JointKind, Vector

OF_REVOLUTE = np.array([1, 2, 4, 5, 6, 8, 9])
"""Inertial parameters of a link that turns; m, h_z and I_yy are the link's before."""
OF_PRISMATIC = np.array([0, 1, 2, 3])
"""Of a link that slides; its moments are the link's before."""


class Structure(NamedTuple):
    """What is known of a tree."""

    parents: tuple[int, ...]
    joints: tuple[JointKind, ...]
    acceleration: float
    """Of gravity, m/s²."""
    friction: bool
    velocity_scale: float
    """Of dry friction, 1/s or m/s."""

    @property
    def gravity(self) -> tuple[float, float, float]:
        """m/s², z up."""
        return (0.0, 0.0, -self.acceleration)

    @property
    def inertial(self) -> np.ndarray:
        """Places in a flat [d, 10] of the inertial parameters of the minimal parametrisation."""
        kept = (OF_REVOLUTE if kind == "revolute" else OF_PRISMATIC for kind in self.joints)
        return np.concatenate([10 * link + own for link, own in enumerate(kept)])

    @property
    def linear_count(self) -> int:
        """P, of the linear parameters."""
        return len(self.inertial) + len(self.joints) * (4 if self.friction else 1)


class Samples(NamedTuple):
    """States and torques, [N, d] each."""

    q: Any
    qd: Any
    qdd: Any
    tau: Any


class Projection(NamedTuple):
    """What is left of the torques once the linear parameters are eliminated, in the joints' units."""

    loss: Any
    """Mean of squares over samples and joints."""
    squares: Any
    """[d], mean over samples."""
    linear: Any
    """[P]: inertial parameters of `Structure.inertial`, armature, and viscous, dry and offset friction."""
    normal: Any
    """JᵀJ [K, K] in the `free_directions`."""
    slope: Any
    """-Jᵀr [K]: the gradient of half the sum of squares is -slope."""


def design(structure: Structure, frames: Frames, q: Vector, qd: Vector, qdd: Vector) -> Float[Array, "d P"]:
    """Phi of one state, without units."""
    d = q.shape[0]
    regressor = scanned_regressor(structure.parents, structure.joints, structure.gravity, *frames, q, qd, qdd)
    columns = [regressor.reshape(d, 10 * d)[:, structure.inertial], jnp.diag(qdd)]
    if structure.friction:
        columns += [jnp.diag(qd), jnp.diag(jnp.tanh(qd / structure.velocity_scale)), jnp.eye(d, dtype=q.dtype)]
    return jnp.concatenate(columns, axis=1)


def inertias_of(structure: Structure, linear: Float[Array, " P"]) -> Float[Array, "d 10"]:
    """The links' inertial parameters, zero where the minimal parametrisation has none."""
    d, places = len(structure.joints), structure.inertial
    return jnp.zeros(10 * d, linear.dtype).at[places].set(linear[: len(places)]).reshape(d, 10)


def project(
    structure: Structure, frames: Frames, samples: Samples, unit: Float[Array, " d"], *, ridge: float
) -> Projection:
    """Eliminates the linear parameters, and gives the normal equations of a step of the frames.

    Args:
        structure: what is known.
        frames: that are tried.
        samples: to explain.
        unit: of each joint's torque, N m or N.
        ridge: added to the Gram matrix of the columns, each scaled to length one.
    """
    *state, tau = samples
    equations = tau.size
    Phi = jax.vmap(lambda *one: design(structure, frames, *one))(*state) / unit[:, None]
    Phi, y = Phi.reshape(equations, -1), (tau / unit).ravel()
    gram = Phi.T @ Phi
    lengths = jnp.sqrt(jnp.diag(gram))
    seen = lengths > 1e-9 * jnp.max(lengths)  # others are rounding, which scaling would blow up
    scale = jnp.where(seen, lengths, 1.0)
    both = seen[:, None] & seen
    gram = jnp.where(both, gram / (scale[:, None] * scale), 0.0) + jnp.diag(jnp.where(seen, ridge, 1.0))
    factor = jnp.linalg.cholesky(gram)
    known = jnp.where(seen, Phi.T @ y / scale, 0.0)
    linear = jnp.where(seen, jax.scipy.linalg.cho_solve((factor, True), known) / scale, 0.0)
    r = y - Phi @ linear

    inertias = inertias_of(structure, linear)

    def force(step: Array, *state: Vector) -> Vector:
        moved = displaced(frames, step)
        return scanned_forces(structure.parents, structure.joints, structure.gravity, *moved, inertias, *state) / unit

    still = jnp.zeros((tau.shape[1], 6), tau.dtype)
    places = free_directions(structure.parents, structure.joints)
    changes = jax.vmap(lambda *one: jax.jacrev(force)(still, *one))(*state).reshape(equations, -1)[:, places]
    overlap = jnp.where(seen[:, None], Phi.T @ changes / scale[:, None], 0.0)
    spanned = jax.scipy.linalg.solve_triangular(factor, overlap, lower=True)
    squares = r.reshape(tau.shape) ** 2
    return Projection(
        loss=jnp.mean(squares),
        squares=jnp.mean(squares, axis=0),
        linear=linear,
        normal=changes.T @ changes - spanned.T @ spanned,
        slope=changes.T @ r,
    )
