"""Forces of a tree with learned frames, by one scan over its links: quick to compile and to differentiate.

`recursions` unrolls the links, so that zeros of known frames cost nothing. Here no frame is known, and every joint is
about z of its link, whatever the tree's axes. In every link's frame the scan carries the link's motions for unit rates
of the joints (the columns of its Jacobian), its own motion and its acceleration, all as spatial vectors (Featherstone,
Rigid Body Dynamics Algorithms, 2008). The forces of the links are then independent.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float

from dln_jax.mechanics.trees.description import Tree
from dln_jax.mechanics.trees.frames import hat
from dln_jax.mechanics.trees.inertia import parts
from dln_jax.types import Vector


def scanned_regressor(tree: Tree, q: Vector, qd: Vector, qdd: Vector) -> Float[Array, "d d 10"]:
    """Returns d tau / d theta: joint forces for unit inertial parameters of the links, without armature."""

    def of_link(angular: Array, linear: Array) -> Array:
        w, dw, a = _motion(angular, linear)
        turning = hat(w)
        force = jnp.concatenate([a[:, None], hat(dw) + turning @ turning], axis=1)
        moment = jnp.concatenate([-hat(a), _moments(dw) + turning @ _moments(w)], axis=1)
        by_force, by_moment = linear[:, :-2].T @ force, angular[:, :-2].T @ moment
        return jnp.pad(by_force, ((0, 0), (0, 6))) + jnp.pad(by_moment, ((0, 0), (1, 0)))

    return jnp.swapaxes(jax.vmap(of_link)(*_spatial(tree, q, qd, qdd)), 0, 1)


def scanned_forces(tree: Tree, q: Vector, qd: Vector, qdd: Vector) -> Vector:
    """Returns the generalised force tau [d] of a motion, like `newton_euler` without armature."""

    def of_link(angular: Array, linear: Array, theta: Array) -> Array:
        w, dw, a = _motion(angular, linear)
        m, h, moments = parts(theta)
        force = m * a + jnp.cross(dw, h) + jnp.cross(w, jnp.cross(w, h))
        moment = jnp.cross(h, a) + moments @ dw + jnp.cross(w, moments @ w)
        return linear[:, :-2].T @ force + angular[:, :-2].T @ moment

    return jnp.sum(jax.vmap(of_link)(*_spatial(tree, q, qd, qdd), tree.inertias), axis=0)


def _spatial(tree: Tree, q: Vector, qd: Vector, qdd: Vector) -> tuple[Float[Array, "d 3 n"], Float[Array, "d 3 n"]]:
    """Returns angular and linear parts in the links' frames: d columns of the Jacobian, velocity, acceleration."""
    parents, rotations = tree.parents, tree.rotations
    d = len(parents)
    turns = np.array([kind == "revolute" for kind in tree.joints], float)
    c, s = jnp.where(turns > 0, jnp.cos(q), 1.0), jnp.where(turns > 0, jnp.sin(q), 0.0)
    zero, one = jnp.zeros_like(c), jnp.ones_like(c)
    about_z = jnp.stack([jnp.stack(row, -1) for row in ([c, -s, zero], [s, c, zero], [zero, zero, one])], -2)
    into = jnp.swapaxes(rotations @ about_z, -1, -2)
    places = tree.positions + rotations[:, :, 2] * ((1 - turns) * q)[:, None]
    ground = jnp.zeros((2, 3, d + 2), q.dtype).at[1, :, -1].set(-jnp.asarray(tree.gravity, q.dtype))
    serial = tuple(parents) == tuple(range(-1, d - 1))

    def link(carried: Array, inputs: tuple[Array, ...]) -> tuple[Array, Array]:
        index, parent, into, place, turns, rate, change = inputs
        angular, linear = carried if serial else carried[parent]
        linear = into @ (linear - hat(place) @ angular)
        angular = into @ angular
        own = (jnp.arange(d + 1) == index) + 0.0 * rate
        own = own.at[d].set(rate)
        angular = angular.at[2, : d + 1].add(turns * own)
        linear = linear.at[2, : d + 1].add((1 - turns) * own)
        # S qdd + v x S qd
        w, v = angular[:, d], linear[:, d]
        across = jnp.stack([w[1] * rate, -w[0] * rate, change])
        angular = angular.at[:, d + 1].add(turns * across)
        linear = linear.at[:, d + 1].add((1 - turns) * across)
        linear = linear.at[:2, d + 1].add(turns * rate * jnp.stack([v[1], -v[0]]))
        motion = jnp.stack([angular, linear])
        return (motion if serial else carried.at[index].set(motion)), motion

    # Links look up their parent; the ground is stored last, where the index -1 points.
    start = ground if serial else jnp.concatenate([jnp.zeros((d, *ground.shape), q.dtype), ground[None]])
    links = (jnp.arange(d), jnp.asarray(parents), into, places, jnp.asarray(turns, q.dtype), qd, qdd)
    _, motions = lax.scan(link, start, links)
    return motions[:, 0], motions[:, 1]


def _motion(angular: Array, linear: Array) -> tuple[Array, Array, Array]:
    """Returns angular velocity, its rate, and the acceleration of the link's origin."""
    w = angular[:, -2]
    return w, angular[:, -1], linear[:, -1] + jnp.cross(w, linear[:, -2])


def _moments(w: Array) -> Array:
    """Returns the matrix [3, 6] with I w = _moments(w) (I_xx, I_xy, I_xz, I_yy, I_yz, I_zz)."""
    x, y, z = w
    zero = jnp.zeros_like(x)
    rows = [[x, y, z, zero, zero, zero], [zero, x, zero, y, z, zero], [zero, zero, x, zero, y, z]]
    return jnp.stack([jnp.stack(row) for row in rows])
