"""Limits of a motion, and the excess of a state over them.

The excess is relative to the limit, and at most zero inside the limit:

    |x - middle| / half - 1   for positions, velocities, accelerations and forces,   -clearance / 1 m
"""

import fnmatch
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from dln_jax.data.robots import Robot
from dln_jax.mechanics.trees.description import Tree
from dln_jax.mechanics.trees.frames import world_frames
from dln_jax.types import InputError, JointVector

SECONDS_TO_SPEED = 0.2
"""s: assumed time to full velocity without an acceleration limit."""
Clearance = Callable[[Array], Array]
"""q -> clearances [K], m, that must stay positive, such as heights of the links above a table."""


class MotionLimits(NamedTuple):
    """Limits of d joints."""

    position: Float[np.ndarray, "d 2"]
    """Lower and upper, rad or m; finite."""
    velocity: JointVector
    """1/s or m/s; finite."""
    acceleration: JointVector
    """1/s² or m/s²; finite."""
    force: Float[np.ndarray, "d 2"]
    """Lower and upper, N m or N; both infinite for a joint without a limit."""


class Excess(NamedTuple):
    """Excess of one state over each limit, relative to the limit; negative inside, `None` without a limit."""

    position: Any
    """[d]."""
    velocity: Any
    """[d]."""
    acceleration: Any
    """[d]."""
    force: Any
    """[joints with limits]."""
    clearance: Any
    """[K], m."""


def require_limits(limits: MotionLimits, degrees_of_freedom: int, names: tuple[str, ...] = ()) -> None:
    """Raises `InputError` that names the first joint with missing, empty or NaN limits."""
    for kind, array in limits._asdict().items():
        shape = (degrees_of_freedom, 2)[: 2 if kind in ("position", "force") else 1]
        if array.shape != shape:
            raise InputError(f"limits of {kind} have shape {array.shape}; expected {shape}")
        for joint, limit in enumerate(array):
            name = names[joint] if names else str(joint)
            low, high = limit if len(shape) == 2 else (0.0, limit)
            if np.isnan([low, high]).any() or (kind != "force" and np.isinf(low - high)):
                raise InputError(f"joint '{name}' has no limit of {kind}; state one")
            if np.isinf(low) != np.isinf(high):
                raise InputError(f"joint '{name}' has a limit of {kind} on one side, {limit}; expected both or none")
            if not low < high:
                raise InputError(f"joint '{name}' has limits of {kind} {limit}; expected lower < upper, and rates > 0")


def limits_of_robot(
    robot: Robot,
    *,
    position: Any = None,
    velocity: Any = None,
    acceleration: Any = None,
    force: Any = None,
    allow_unlimited: Sequence[str] = (),
) -> tuple[MotionLimits, list[str]]:
    """Returns a robot's limits from its file and the arguments (which take precedence), and the assumptions as text.

    A revolute joint that may be unlimited gets a range of pi to either side and any force. The default acceleration
    limit reaches full velocity in `SECONDS_TO_SPEED`. Velocity limits are never assumed.

    Args:
        robot: from `read_robot`.
        position: half the range about zero, rad or m; this and the following are one number for all joints, or [d].
        velocity: 1/s or m/s.
        acceleration: 1/s² or m/s².
        force: N m or N, in either direction.
        allow_unlimited: names (with * and ?) of joints that may lack limits of force and, if revolute, of position.

    Raises:
        InputError: a joint outside `allow_unlimited` lacks a limit, a velocity limit or a prismatic position limit is
            missing, a pattern matches no joint, or an argument has the wrong number of limits.
    """
    tree, d, assumed = robot.tree, robot.tree.degrees_of_freedom, []
    names = tree.names or tuple(map(str, range(d)))
    rates = {"velocity": np.broadcast_to(robot.velocity_limits, d), "acceleration": None}
    limits = {"position": robot.position_limits, **rates, "force": robot.force_limits}
    stated = {"position": position, "velocity": velocity, "acceleration": acceleration, "force": force}
    for kind, limit in stated.items():
        if limit is None:
            continue
        if np.size(limit) not in (1, d):
            raise InputError(f"{kind} has {np.size(limit)} numbers; expected one, or {d}, one per joint")
        sizes = np.broadcast_to(np.ravel(limit), d)
        limits[kind] = sizes if kind in rates else np.stack([-sizes, sizes], axis=1)
    for pattern in allow_unlimited:
        if not fnmatch.filter(names, pattern):
            raise InputError(f"no joint matches '{pattern}' of --allow-unlimited; the robot has {', '.join(names)}")
    allowed = np.array([any(fnmatch.fnmatchcase(name, pattern) for pattern in allow_unlimited) for name in names])
    if limits["acceleration"] is None:
        limits["acceleration"] = limits["velocity"] / SECONDS_TO_SPEED
        assumed.append(f"no limits of acceleration: full velocity in {SECONDS_TO_SPEED} s is assumed")
    revolute = np.array(tree.joints) == "revolute"
    for kind, option, may_lack, words in (
        ("position", "--position", revolute, "pi to either side is assumed"),
        ("force", "--torque", True, "any is allowed"),
    ):
        absent = ~np.isfinite(limits[kind]).all(axis=1) & may_lack
        if (refused := absent & ~allowed).any():
            name = names[int(np.argmax(refused))]
            raise InputError(
                f"joint '{name}' has no limit of {kind}: state it ({option}, or in the file), or pass "
                f"--allow-unlimited {name} if any position and torque is safe"
            )
        if absent.any():
            listed = "any joint" if absent.all() else ", ".join(np.array(names)[absent])
            assumed.append(f"no limits of {kind} for {listed}: {words}")
        if kind == "position":
            limits[kind] = np.where(absent[:, None], [-np.pi, np.pi], limits[kind])
    checked = MotionLimits(**limits)
    require_limits(checked, d, names)
    return checked, assumed


def heights_above(tree: Tree, height: float) -> Clearance | None:
    """Returns heights of moving link origins above the plane z = height (m); `None` if none moves vertically."""
    postures = np.random.default_rng(0).uniform(-1, 1, (20, tree.degrees_of_freedom))
    rising = np.ptp([world_frames(tree, jnp.asarray(q))[1][:, 2] for q in postures], axis=0) > 1e-9
    return (lambda q: world_frames(tree, q)[1][rising, 2] - height) if rising.any() else None


def scale_limits(limits: MotionLimits, share: float) -> MotionLimits:
    """Reduces limits to a fraction in (0, 1] (else `InputError`); ranges shrink towards their middles."""
    if not 0 < share <= 1:
        raise InputError(f"share is {share}; expected the usable fraction of the limits, in (0, 1]")
    middle = limits.position.mean(axis=1, keepdims=True)
    position = middle + share * (limits.position - middle)
    return MotionLimits(position, share * limits.velocity, share * limits.acceleration, share * limits.force)


def beyond(bounds: np.ndarray, x: Array) -> Array:
    """Returns the excess of numbers over bounds [n, 2], relative to half the range."""
    middle, half = bounds.mean(axis=1), np.diff(bounds, axis=1)[:, 0] / 2
    return jnp.abs(x - middle) / half - 1


def worst(excess: Excess) -> tuple[float, str]:
    """Returns the largest excess over all samples, and its limit; the fields of `excess` have leading sample axes."""
    return max((float(np.max(values)), kind) for kind, values in excess._asdict().items() if values is not None)
