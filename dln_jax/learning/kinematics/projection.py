"""Levenberg-Marquardt on joint frames with variable projection, a few iterations in one program.

For fixed frames, a linear problem gives inertias and friction, which eliminates them:

    tau = Phi(frames) theta,   r = (1 - U Uᵀ) y,   J = -(1 - U Uᵀ) dPhi theta

y has the scaled torques, Phi is scaled in the same way, and U spans its columns. J is Kaufman's (1975) simplification
of Golub and Pereyra's derivative: its gradient Jᵀr is exact, and it needs no derivative of U. The columns belong to a
minimal parametrisation, in which the parent link absorbs the other parameters (Khalil and Dombre 2002, section 9.4),
and have length one. A ridge relative to them fixes undetermined directions. Only sums over samples are formed, so a
step takes milliseconds. `fit` solves the final linear problem to full precision.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from dln_jax.learning.kinematics.frames import Frames, displace, free_directions
from dln_jax.mechanics.trees.description import Tree
from dln_jax.mechanics.trees.recursions import scanned_forces, scanned_regressor
from dln_jax.precision import compiled
from dln_jax.types import JointKind, Vector

LENGTH = 0.3
"""Length in m that counts as one radian in the damping."""
LARGEST_STEP = 0.6
"""Largest step of a coordinate, in rad or units of `LENGTH`; longer steps are scaled down."""
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-2, 1e-12, 1e3
"""Initial, smallest and largest damping, relative to the mean diagonal of JᵀJ; a descent ends at the largest."""
FEWER, MORE = 0.2, 5.0
"""Factors on the damping after a successful step and after a failed one."""
CHUNK = 10
"""Iterations per dispatch."""
SETTLED = 1e-4
"""A descent ends when the loss decreases by less than this fraction over a chunk."""
OF_REVOLUTE = np.array([1, 2, 4, 5, 6, 8, 9])
"""Inertial parameters of a revolute link; the parent link absorbs m, h_z and I_yy."""
OF_PRISMATIC = np.array([0, 1, 2, 3])
"""Inertial parameters of a prismatic link; the parent link absorbs its moments."""


class Structure(NamedTuple):
    """Known properties of a tree."""

    parents: tuple[int, ...]
    joints: tuple[JointKind, ...]
    acceleration: float
    """Acceleration of gravity, m/s²."""
    friction: bool
    velocity_scale: float
    """Velocity scale of dry friction, 1/s or m/s."""

    def tree(self, frames: Frames, inertias: Any = None) -> Tree:
        """Returns the tree with these frames; gravity points against z."""
        return Tree(self.parents, self.joints, *frames, None, inertias, None, (0.0, 0.0, -self.acceleration))

    @property
    def inertial(self) -> np.ndarray:
        """Returns the indices of the minimal inertial parameters in a flat [d, 10]."""
        kept = (OF_REVOLUTE if kind == "revolute" else OF_PRISMATIC for kind in self.joints)
        return np.concatenate([10 * link + own for link, own in enumerate(kept)])

    @property
    def linear_count(self) -> int:
        """P, the number of linear parameters."""
        return len(self.inertial) + len(self.joints) * (4 if self.friction else 1)


Samples = tuple[Any, Any, Any, Any]
"""q, qd, qdd and tau, as arrays [N, d]."""


class Projection(NamedTuple):
    """Residual torques after elimination of the linear parameters, in the joints' units."""

    loss: Any
    """Mean square over samples and joints."""
    squares: Any
    """[d], mean squares over samples."""
    linear: Any
    """[P]: inertial parameters of `Structure.inertial`, armature, and viscous, dry and offset friction."""
    normal: Any
    """JᵀJ [K, K] in the `free_directions`."""
    slope: Any
    """-Jᵀr [K]: the gradient of half the sum of squares is -slope."""


def design(structure: Structure, frames: Frames, q: Vector, qd: Vector, qdd: Vector) -> Float[Array, "d P"]:
    """Returns the unscaled Phi of one state."""
    d = q.shape[0]
    regressor = scanned_regressor(structure.tree(frames), q, qd, qdd)
    columns = [regressor.reshape(d, 10 * d)[:, structure.inertial], jnp.diag(qdd)]
    if structure.friction:
        columns += [jnp.diag(qd), jnp.diag(jnp.tanh(qd / structure.velocity_scale)), jnp.eye(d, dtype=q.dtype)]
    return jnp.concatenate(columns, axis=1)


def inertias_of(structure: Structure, linear: Float[Array, " P"]) -> Float[Array, "d 10"]:
    """Returns the inertial parameters of the links, with zeros outside the minimal parametrisation."""
    d, places = len(structure.joints), structure.inertial
    return jnp.zeros(10 * d, linear.dtype).at[places].set(linear[: len(places)]).reshape(d, 10)


def project(
    structure: Structure, frames: Frames, samples: Samples, unit: Float[Array, " d"], *, ridge: float
) -> Projection:
    """Eliminates the linear parameters and returns the normal equations for a step of the frames.

    Args:
        unit: scale of the joints' torques, N m or N.
        ridge: added to the diagonal of the Gram matrix of the columns of length one.
    """
    *state, tau = samples
    equations = tau.size
    Phi = jax.vmap(lambda *one: design(structure, frames, *one))(*state) / unit[:, None]
    Phi, y = Phi.reshape(equations, -1), (tau / unit).ravel()
    gram = Phi.T @ Phi
    lengths = jnp.sqrt(jnp.diag(gram))
    seen = lengths > 1e-9 * jnp.max(lengths)  # shorter columns are rounding
    scale = jnp.where(seen, lengths, 1.0)
    both = seen[:, None] & seen
    gram = jnp.where(both, gram / (scale[:, None] * scale), 0.0) + jnp.diag(jnp.where(seen, ridge, 1.0))
    factor = jnp.linalg.cholesky(gram)
    known = jnp.where(seen, Phi.T @ y / scale, 0.0)
    linear = jnp.where(seen, jax.scipy.linalg.cho_solve((factor, True), known) / scale, 0.0)
    r = y - Phi @ linear

    inertias = inertias_of(structure, linear)

    def force(step: Array, *state: Vector) -> Vector:
        return scanned_forces(structure.tree(displace(frames, step), inertias), *state) / unit

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


class Descent(NamedTuple):
    """State of a descent."""

    frames: Frames
    at: Projection
    damping: Any


Program = Callable[[Descent, Samples, Array], Descent]
"""(state, samples, scales of the joints' torques) -> the state after `CHUNK` iterations."""


def make_program(structure: Structure, *, ridge: float) -> Program:
    """Returns the program for a structure; it compiles once per number of samples."""
    places = free_directions(structure.parents, structure.joints)
    lengths = np.where(places % 6 < 3, 1.0, LENGTH)
    d = len(structure.joints)

    def iteration(state: Descent, samples: Samples, unit: Array) -> Descent:
        normal = state.at.normal
        typical = jnp.trace(normal) / len(places)
        damped = normal + state.damping * typical * jnp.diag(lengths**-2.0)
        step = jnp.linalg.solve(damped, state.at.slope)
        longest = jnp.max(jnp.abs(step) / lengths)
        step = step * jnp.minimum(1.0, LARGEST_STEP / jnp.maximum(longest, LARGEST_STEP))
        frames = displace(state.frames, jnp.zeros(6 * d).at[places].set(step).reshape(d, 6))
        at = project(structure, frames, samples, unit, ridge=ridge)
        lower = at.loss < state.at.loss  # false for NaN
        damping = jnp.clip(state.damping * jnp.where(lower, FEWER, MORE), LEAST_DAMPING, MOST_DAMPING)
        frames, at = jax.tree.map(lambda new, old: jnp.where(lower, new, old), (frames, at), state[:2])
        return Descent(frames, at, damping)

    def iterate(state: Descent, samples: Samples, unit: Array) -> Descent:
        return lax.fori_loop(0, CHUNK, lambda _, state: iteration(state, samples, unit), state)

    return compiled(iterate)


def descend(
    program: Program,
    structure: Structure,
    frames: Frames,
    samples: Samples,
    unit: Any,
    *,
    iterations: int,
    expired: Callable[[], bool] = lambda: False,
) -> Descent:
    """Iterates until the loss settles, no step lowers it, or iterations or time run out."""
    samples, unit = jax.tree.map(jnp.asarray, (samples, unit))
    directions = len(free_directions(structure.parents, structure.joints))
    # The first iteration only evaluates the frames, since a zero slope gives no step.
    at = Projection(
        loss=jnp.asarray(jnp.inf),
        squares=jnp.zeros(len(structure.joints)),
        linear=jnp.zeros(structure.linear_count),
        normal=jnp.eye(directions),
        slope=jnp.zeros(directions),
    )
    state = Descent(jax.tree.map(jnp.asarray, frames), at, jnp.asarray(FIRST_DAMPING / FEWER))
    before = np.inf
    for _ in range(0, iterations, CHUNK):
        state = program(state, samples, unit)
        now = float(state.at.loss)
        if not now < before * (1 - SETTLED) or float(state.damping) >= MOST_DAMPING or expired():
            break
        before = now
    return state
