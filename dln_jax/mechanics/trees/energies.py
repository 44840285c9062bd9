"""Energies of a tree, and its record with forces by recursions."""

import jax.numpy as jnp

from dln_jax.mechanics.dynamics import friction_force
from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.mechanics.recursive import RecursiveSystem
from dln_jax.mechanics.trees.description import Tree
from dln_jax.mechanics.trees.frames import aligned, cross, inwards, outwards, placed
from dln_jax.mechanics.trees.inertia import parts
from dln_jax.mechanics.trees.recursions import composite_bodies, newton_euler
from dln_jax.types import Dissipation, Lagrangian, Scalar, Vector


def kinetic_energy(tree: Tree, q: Vector, qd: Vector) -> Scalar:
    """T = sum over links of ½ m |v|² + v . (ω x h) + ½ ω . I ω, and of ½ armature qd²."""
    tree = aligned(tree)
    frames, moving = placed(tree, q), []
    total = 0.5 * jnp.sum(tree.armature * qd**2)
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
    """V = -sum over links of gravity . (m p + R h), zero if all centres of mass are at the ground's origin."""
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
    """L(q, qd) = T - V, from which all dynamics follow."""
    return lambda q, qd: kinetic_energy(tree, q, qd) - potential_energy(tree, q)


def tree_energies(tree: Tree, dissipation: Dissipation | None = None) -> LagrangianSystem:
    """Returns a record of the Lagrangian alone, with derivatives as forces; equal to `tree_system`, but slower."""
    return LagrangianSystem(lagrangian(tree), dissipation)


def tree_system(tree: Tree, dissipation: Dissipation | None = None) -> RecursiveSystem:
    """Returns the record for `equations.dynamics`, with forces by recursions.

    Args:
        tree: of known or learned numbers.
        dissipation: (q, qd) -> Rayleigh function.
    """
    friction = None if dissipation is None else (lambda q, qd: friction_force(dissipation, q, qd))
    return RecursiveSystem(
        mass_matrix=lambda q: composite_bodies(tree, q),
        forces=lambda q, qd, qdd: newton_euler(tree, q, qd, qdd),
        potential=(lambda q: potential_energy(tree, q)) if tree.needs.gravity else None,
        dissipation=dissipation,
        friction=friction,
    )
