"""Description of a tree of rigid bodies: its structure, joint frames and axes, and inertias."""

import reprlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from dln_jax.mechanics.trees.inertia import Inertia, moved
from dln_jax.types import InputError, JointKind, Needs, finite_array

EARTH = (0.0, 0.0, -9.81)
"""m/s², z up."""


class Tree(NamedTuple):
    """Rigid bodies in a tree of d joints. Each joint moves one link, and the origin of the link's frame is at the
    joint.

    At q = 0, link i has the rotation `rotations[i]` and the position `positions[i]` in the frame of its parent link. It
    rotates about `axes[i]`, or slides along it, in its own frame. The structure is plain Python. Known numbers are
    NumPy arrays (zeros among them then cost nothing), learned ones JAX arrays.
    """

    parents: tuple[int, ...]
    """Parent of every link, an earlier link; -1 is the ground."""
    joints: tuple[JointKind, ...]
    rotations: Any
    """[d, 3, 3]; columns are the axes of the link's frame."""
    positions: Any
    """[d, 3], m."""
    axes: Any
    """[d, 3], unit vectors."""
    inertias: Any
    """[d, 10], inertial parameters of the links in their own frames, in the order of `inertia.PARAMETERS`."""
    armature: Any
    """[d], motor inertias reflected to the joints, kg m² or kg; [d, d] if motors turn with several joints."""
    gravity: Any = np.array(EARTH)
    """[3], m/s², in the frame of the ground."""
    names: tuple[str, ...] = ()
    """Names of the joints, if any."""

    @property
    def degrees_of_freedom(self) -> int:
        """d."""
        return len(self.parents)

    @property
    def needs(self) -> Needs:
        """Needs of a model of the tree. Friction is specified separately."""
        still = isinstance(self.gravity, np.ndarray) and not self.gravity.any()
        return Needs(joints=self.joints, gravity=not still)


def make_tree(
    parents: Sequence[int],
    joints: Sequence[str],
    rotations: Any,
    positions: Any,
    axes: Any,
    inertias: Any,
    *,
    armature: Any = None,
    gravity: Any = EARTH,
    names: Sequence[str] = (),
) -> Tree:
    """Builds a tree of known numbers and checks its structure and shapes; axes are normalised.

    Raises:
        InputError: links are out of order, joints are of another kind, arrays have another shape or are not finite, a
            rotation is invalid, an armature is negative, or an axis has length zero.
    """
    d = len(parents)
    if d == 0 or any(not -1 <= parent < link for link, parent in enumerate(parents)):
        raise InputError(f"parents are {tuple(parents)}; expected an earlier link for each link, or -1 for the ground")
    if len(joints) != d or not set(joints) <= {"revolute", "prismatic"}:
        raise InputError(f"joints are {tuple(joints)!r:.100}; expected {d} of revolute and prismatic")
    if names and (len(names) != d or len(set(names)) < d):
        raise InputError(f"names are {tuple(names)!r:.100}; expected {d} different ones")
    arrays = {
        "rotations": (rotations, (d, 3, 3)),
        "positions": (positions, (d, 3)),
        "axes": (axes, (d, 3)),
        "inertias": (inertias, (d, 10)),
        "armature": (np.zeros(d) if armature is None else armature, (d, d) if np.ndim(armature) == 2 else (d,)),
        "gravity": (gravity, (3,)),
    }
    checked = {name: finite_array(name, array, shape) for name, (array, shape) in arrays.items()}
    turned = checked["rotations"]
    if np.abs(turned @ turned.transpose(0, 2, 1) - np.eye(3)).max() > 1e-6 or (np.linalg.det(turned) < 0).any():
        raise InputError("rotations has an invalid matrix; expected orthonormal right-handed columns")
    A = checked["armature"]
    if A.ndim == 2 and (np.abs(A - A.T).max() > 1e-9 * np.abs(A).max() or np.linalg.eigvalsh(A)[0] < -1e-9 * A.max()):
        raise InputError("armature is not symmetric positive semidefinite; expected the inertia matrix of the motors")
    lengths = np.linalg.norm(checked["axes"], axis=1)
    if not (lengths > 0).all():
        raise InputError(f"joint {int(np.argmin(lengths))} has an axis of length zero; expected a direction")
    checked["axes"] = checked["axes"] / lengths[:, None]
    kinds: list[JointKind] = ["revolute" if joint == "revolute" else "prismatic" for joint in joints]
    return Tree(tuple(map(int, parents)), tuple(kinds), names=tuple(names), **checked)


def serial(rotations: Any, positions: Any, inertias: Any, *, axes: Any = None, **others: Any) -> Tree:
    """Builds an arm: a serial chain, by default of revolute joints about z. Other arguments as for `make_tree`."""
    d = np.shape(positions)[0]
    axes = np.tile([0.0, 0.0, 1.0], (d, 1)) if axes is None else axes
    joints = others.pop("joints", ("revolute",) * d)
    return make_tree(range(-1, d - 1), joints, rotations, positions, axes, inertias, **others)


def dh_frames(rows: Any) -> tuple[np.ndarray, np.ndarray]:
    """Returns rotations [d, 3, 3] and positions [d, 3] of an arm with joints about z, from Denavit-Hartenberg rows.

    Args:
        rows: [d, 4], modified (Craig): a row (alpha, a, d, theta) is a rotation by alpha in rad about x and a shift by
            a in m along it, then a rotation by theta about z and a shift by d along it.

    Raises:
        InputError: rows have another shape.
    """
    table = np.asarray(rows, float)
    if table.ndim != 2 or table.shape[1] != 4:
        raise InputError(f"rows have shape {table.shape}; expected [d, 4]: alpha, a, d, theta")
    alpha, a, offset, theta = table.T
    sa, ca, st, ct, zero = np.sin(alpha), np.cos(alpha), np.sin(theta), np.cos(theta), 0 * a
    rotations = np.array([[ct, -st, zero], [st * ca, ct * ca, -sa], [st * sa, ct * sa, ca]]).transpose(2, 0, 1)
    positions = np.stack([a, -sa * offset, ca * offset], axis=1)
    rounded = np.where(np.abs(rotations) < 1e-15, 0.0, rotations)
    return rounded, np.where(np.abs(positions) < 1e-15, 0.0, positions)


def with_payload(tree: Tree, link: int, inertia: Inertia, *, rotation: Any = None, position: Any = None) -> Tree:
    """Adds a body fixed to a link; rotation and position place the body's frame in the link's frame.

    Raises:
        InputError: there is no such link.
    """
    if not 0 <= link < tree.degrees_of_freedom:
        raise InputError(f"link is {link}; expected 0 to {tree.degrees_of_freedom - 1}")
    there = moved(inertia, np.eye(3) if rotation is None else rotation, np.zeros(3) if position is None else position)
    return tree._replace(inertias=tree.inertias + there * (np.arange(tree.degrees_of_freedom) == link)[:, None])


def tree_to_json(tree: Tree) -> dict[str, Any]:
    """Returns the tree's fields, with numbers as lists in double precision."""
    fields = tree._asdict()
    structure = {name: list(fields.pop(name)) for name in ("parents", "joints", "names")}
    return {**structure, **{name: np.asarray(numbers, float).tolist() for name, numbers in fields.items()}}


def tree_from_json(values: Any) -> Tree:
    """Returns the tree from the output of `tree_to_json`.

    Raises:
        InputError: fields are missing or unknown, or `make_tree` refuses them.
    """
    if not isinstance(values, Mapping) or set(values) != set(Tree._fields):
        raise InputError(f"tree: expected the fields {', '.join(Tree._fields)}, got {reprlib.repr(values)}")
    try:
        return make_tree(**values)
    except InputError as error:
        raise InputError(f"tree: {error}") from None
    except (TypeError, ValueError) as error:
        raise InputError(f"tree: {reprlib.repr(str(error))}; expected numbers, and names of joints") from error
