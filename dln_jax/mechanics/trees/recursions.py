"""Energies of a tree, and its dynamics by recursions over its links, for one state.

`newton_euler` gives forces (Luh, Walker and Paul 1980), `composite_bodies` the mass matrix (Walker and Orin 1982); both
after Featherstone, Rigid Body Dynamics Algorithms, 2008, in about a hundred operations per link. Vectors are in the
frame of their link, forces about its origin. Gravity is an acceleration of the ground.

These unroll the links, so that zeros of known frames cost nothing. `scanned_forces` and `scanned_regressor` instead
scan the links of a tree with learned frames, which compiles and differentiates fast. They assume that every joint turns
about z of its link, and ignore the tree's axes. In every link's frame the scan carries the Jacobian of the link (its
motions for unit rates of the joints), its velocity and its acceleration, all as spatial vectors. The forces of the
links are then independent.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float

from dln_jax.mechanics.explicit import ExplicitSystem
from dln_jax.mechanics.trees.description import Tree
from dln_jax.mechanics.trees.frames import Placed, aligned, cross, hat, inwards, outwards, placed
from dln_jax.mechanics.trees.inertia import parts
from dln_jax.types import Dissipation, Lagrangian, Matrix, Scalar, Vector


def newton_euler(tree: Tree, q: Vector, qd: Vector, qdd: Vector) -> Vector:
    """Returns the generalised force tau [d] of a motion, with gravity and armature, without friction."""
    tree = aligned(tree)
    frames = placed(tree, q)
    forces: list[Any] = []
    motions: list[Any] = []
    for link, (parent, frame) in enumerate(zip(tree.parents, frames, strict=True)):
        w, dw, a = _on_parent(motions[parent] if parent >= 0 else None, frame, tree.gravity)
        rate, change = qd[link], qdd[link]
        across = jnp.zeros(2, q.dtype) if w is None else jnp.stack([w[1] * rate, -w[0] * rate])
        if tree.joints[link] == "prismatic":
            a = a + jnp.append(2 * across, change)
        elif w is None:
            w, dw = jnp.append(across, rate), jnp.append(across, change)
        else:
            w, dw = jnp.append(w[:2], w[2] + rate), dw + jnp.append(across, change)
        motions.append((w, dw, a))
        forces.append(_force(tree.inertias[link], w, dw, a))
    tau: list[Any] = [None] * len(frames)
    for link in reversed(range(len(frames))):
        force, moment = forces[link]
        tau[link] = moment[2] if tree.joints[link] == "revolute" else force[2]
        parent = tree.parents[link]
        if parent >= 0:
            carried, turned = inwards(frames[link], force), inwards(frames[link], moment)
            before = forces[parent]
            forces[parent] = (before[0] + carried, before[1] + turned + cross(frames[link].position, carried))
    return jnp.stack(tau) + _motor_momentum(tree, qdd)


def _motor_momentum(tree: Tree, rates: Vector) -> Vector:
    """Returns A qd, the momentum of the motors, or their force A qdd."""
    return tree.armature @ rates if np.ndim(tree.armature) == 2 else tree.armature * rates


def _on_parent(motion: Any, frame: Placed, gravity: Any) -> tuple[Any, Any, Any]:
    """Returns angular velocity and acceleration, and the acceleration of the link's origin, with the joint locked.

    Angular quantities are `None` where they are zero: on the ground, and on links connected to it by prismatic joints
    only.
    """
    if motion is None:
        return None, None, outwards(frame, -jnp.asarray(gravity, jnp.result_type(float)))
    w, dw, a = motion
    if w is not None:
        r = frame.position
        a = a + cross(dw, r) + cross(w, cross(w, r))
        w, dw = outwards(frame, w), outwards(frame, dw)
    return w, dw, outwards(frame, a)


def _force(theta: Any, w: Any, dw: Any, a: Any) -> tuple[Any, Any]:
    """Returns the force and moment that accelerate a body."""
    m, h, moments = parts(theta)
    force, moment = m * a, cross(h, a)
    if w is not None:
        force = force + cross(dw, h) + cross(w, cross(w, h))
        moment = moment + moments @ dw + cross(w, moments @ w)
    return force, moment


def composite_bodies(tree: Tree, q: Vector) -> Matrix:
    """Returns the mass matrix M [d, d], including the armature."""
    tree = aligned(tree)
    frames = placed(tree, q)
    d = len(frames)
    bodies = [parts(theta) for theta in tree.inertias]
    M: dict[tuple[int, int], Any] = {}
    for link in reversed(range(d)):
        m, h, moments = bodies[link]
        if tree.joints[link] == "revolute":  # momentum of a unit rate
            force, moment = jnp.stack([-h[1], h[0], jnp.zeros_like(h[0])]), moments[:, 2]
        else:
            force, moment = jnp.stack([*(jnp.zeros_like(m),) * 2, m]), jnp.stack([h[1], -h[0], jnp.zeros_like(m)])
        M[link, link] = moment[2] if tree.joints[link] == "revolute" else force[2]
        other, frame = link, frames[link]
        while tree.parents[other] >= 0:
            force, moment = inwards(frame, jnp.asarray(force)), inwards(frame, jnp.asarray(moment))
            moment = moment + cross(frame.position, force)
            other = tree.parents[other]
            frame = frames[other]
            M[link, other] = M[other, link] = moment[2] if tree.joints[other] == "revolute" else force[2]
        if tree.parents[link] >= 0:
            carried = _carried(bodies[link], frames[link])
            bodies[tree.parents[link]] = tuple(a + b for a, b in zip(bodies[tree.parents[link]], carried, strict=True))
    zero = jnp.zeros((), q.dtype)
    rows = [jnp.stack([jnp.asarray(M.get((i, j), zero)) for j in range(d)]) for i in range(d)]
    armature = jnp.asarray(tree.armature, q.dtype)
    return jnp.stack(rows) + (armature if armature.ndim == 2 else jnp.diag(armature))


def _carried(body: tuple[Any, Any, Any], frame: Placed) -> tuple[Any, Any, Any]:
    """Returns m, h and I of a body in the frame of the parent link."""
    m, h, moments = body
    turned = inwards(frame, jnp.asarray(h))
    half = jnp.stack([inwards(frame, column) for column in jnp.asarray(moments).T], axis=1)
    there = jnp.stack([inwards(frame, row) for row in half])
    r = jnp.asarray(frame.position)
    shifted = (2 * (turned @ r) + m * (r @ r)) * np.eye(3)
    outer = turned[:, None] * r
    return m, turned + m * r, there + shifted - outer - outer.T - m * r[:, None] * r


def regressor(tree: Tree, q: Vector, qd: Vector, qdd: Vector) -> Float[Array, "d P"]:
    """Returns Phi with tau = Phi theta; theta is the links' ten parameters end to end, then the armature [d]."""

    def force(inertias: Array, armature: Array) -> Vector:
        return newton_euler(tree._replace(inertias=inertias, armature=armature), q, qd, qdd)

    d = q.shape[0]
    _, pull_back = jax.vjp(force, jnp.zeros((d, 10), q.dtype), jnp.zeros(d, q.dtype))
    by_link, by_motor = jax.vmap(pull_back)(jnp.eye(d, dtype=q.dtype))
    return jnp.concatenate([by_link.reshape(d, -1), by_motor], axis=1)


def kinetic_energy(tree: Tree, q: Vector, qd: Vector) -> Scalar:
    """Returns T = sum over links of ½ m |v|² + v . (ω x h) + ½ ω . I ω, plus ½ qd . A qd of the armature."""
    tree = aligned(tree)
    frames, moving = placed(tree, q), []
    total = 0.5 * qd @ _motor_momentum(tree, qd)
    z = jnp.array([0.0, 0.0, 1.0], q.dtype)
    for link, (parent, frame) in enumerate(zip(tree.parents, frames, strict=True)):
        w, v = moving[parent] if parent >= 0 else (jnp.zeros(3, q.dtype), jnp.zeros(3, q.dtype))
        v = outwards(frame, v + cross(w, frame.position))
        w = outwards(frame, w)
        w, v = (w + z * qd[link], v) if tree.joints[link] == "revolute" else (w, v + z * qd[link])
        moving.append((w, v))
        m, h, moments = parts(tree.inertias[link])
        total += 0.5 * m * (v @ v) + v @ cross(w, h) + 0.5 * w @ (moments @ w)
    return total


def potential_energy(tree: Tree, q: Vector) -> Scalar:
    """Returns V = -sum over links of gravity . (m p + R h), zero if all centres of mass are at the ground's origin."""
    tree = aligned(tree)
    frames = placed(tree, q)
    # Mass and first moment of the subtree of a link, from the tips to the ground.
    hanging = [parts(theta)[:2] for theta in tree.inertias]
    total = jnp.zeros(3, q.dtype)
    for link in reversed(range(len(frames))):
        m, h = hanging[link]
        carried = inwards(frames[link], jnp.asarray(h)) + m * jnp.asarray(frames[link].position)
        parent = tree.parents[link]
        if parent >= 0:
            hanging[parent] = hanging[parent][0] + m, hanging[parent][1] + carried
        else:
            total = total + carried
    return -jnp.asarray(tree.gravity, q.dtype) @ total


def lagrangian(tree: Tree) -> Lagrangian:
    """Returns L(q, qd) = T - V; its `LagrangianSystem` equals `tree_system`, but is slower."""
    return lambda q, qd: kinetic_energy(tree, q, qd) - potential_energy(tree, q)


def tree_system(tree: Tree, dissipation: Dissipation | None = None) -> ExplicitSystem:
    """Returns the system of a tree of rigid bodies, for `dynamics` and `flow`.

    Forces come from the recursive Newton-Euler algorithm (Luh, Walker and Paul 1980), the mass matrix from composite
    rigid bodies (Walker and Orin 1982). Cost grows linearly with the number of links for forces.

    Args:
        tree: a tree of known or learned numbers, from `read_robot`, `make_tree` or `serial`.
        dissipation: (q, qd) -> Rayleigh function in W, such as from `joint_dissipation`.

    Example:
        >>> import numpy as np
        >>> import dln_jax
        >>> from dln_jax.mechanics.trees.description import serial
        >>> inertia = [[2.0, 0.6, 0, 0, 0.1, 0, 0, 0.2, 0, 0.2]]  # m, m c (kg m), ixx ixy ixz iyy iyz izz (kg m²)
        >>> arm = serial(np.eye(3)[None], [[0, 0, 0]], inertia, gravity=(0, -9.81, 0))
        >>> torque = dln_jax.dynamics(dln_jax.tree_system(arm)).inverse_dynamics([0.0], [0.0], [1.0])
        >>> print(f"{torque[0]:.3f} N m")  # 0.2 kg m² times 1 rad/s², and 0.6 kg m times 9.81 m/s²
        6.086 N m
    """
    return ExplicitSystem(
        mass_matrix=lambda q: composite_bodies(tree, q),
        forces=lambda q, qd, qdd: newton_euler(tree, q, qd, qdd),
        potential=(lambda q: potential_energy(tree, q)) if tree.needs.gravity else None,
        dissipation=dissipation,
    )


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
