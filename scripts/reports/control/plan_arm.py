"""A seven-axis arm for plans, its axes alternating between z and y, as formulas for JAX and for CasADi alike.

Masses are points: elbow, wrist, and a tool beside the last axis.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

GRAVITY = 9.81
LINKS = (0.34, 0.40, 0.40, 0.126)
"""Lengths between base, shoulder, elbow, wrist and tip, m."""
AXES = "zyzyzyz"
PAIRS = ((LINKS[0], 3.5, 0.0, LINKS[1]), (LINKS[1], 3.0, 0.0, LINKS[2]), (LINKS[2], 0.0, 0.0, 0.0),
         (0.0, 1.5, 0.05, LINKS[3]))  # fmt: skip
"""For an axis z and the next axis y: length between them, m; mass, kg, and its x and z in their frame, m."""
TORQUES = (3.0, 30.0, 12.0, 12.0, 2.0, 2.0, 0.6)
"""Limits of the torques, N m."""
OBSTACLE, RADIUS = (0.55, 0.0, 0.45), 0.16
"""Centre and radius of the sphere, m."""
TARGET = (0.5, 0.4, 0.4)

Vector = list[Any]


def add(a: Any, b: Any) -> Vector:
    """a + b."""
    return [p + q for p, q in zip(a, b, strict=True)]


def scaled(size: Any, v: Any) -> Vector:
    """A multiple of a vector."""
    return [size * p for p in v]


def cross(a: Any, b: Any) -> Vector:
    """a x b."""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def dot(a: Any, b: Any) -> Any:
    """Scalar product."""
    return sum(p * q for p, q in zip(a, b, strict=True))


def turned(frame: list[Vector], axis: str, c: Any, s: Any) -> list[Vector]:
    """The axes of a frame after a rotation about one of them."""
    x, y, z = frame
    if axis == "z":
        return [add(scaled(c, x), scaled(s, y)), add(scaled(c, y), scaled(-s, x)), z]
    return [add(scaled(c, x), scaled(-s, z)), y, add(scaled(c, z), scaled(s, x))]


def points(f: Any, q: Any) -> list[Vector]:
    """Elbow, wrist and tip."""
    frame, at, ends = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], [0.0, 0.0, LINKS[0]], []
    for i, axis in enumerate(AXES):
        frame = turned(frame, axis, f.cos(q[i]), f.sin(q[i]))
        if i in (1, 3, 6):
            at = add(at, scaled(LINKS[(i + 1) // 2 if i < 6 else 3], frame[2]))
            ends.append(at)
    return ends


def clear_of_sphere(f: Any, x: Any) -> list[Any]:
    """RADIUS² - distance² of the middle of the forearm, wrist and tip."""
    elbow, wrist, tip = points(f, x)
    off = [add(point, scaled(-1, OBSTACLE)) for point in (scaled(0.5, add(elbow, wrist)), wrist, tip)]
    return [RADIUS**2 - dot(d, d) for d in off]


def tip_error(f: Any, x: Any) -> Any:
    """Squared distance of the tip from its target."""
    d = add(points(f, x)[2], scaled(-1, TARGET))
    return dot(d, d)


def repeated(f: Any, step: Callable[..., tuple[Any, Any]], state: Any, rows: list[list[Any]]) -> list[Any]:
    """The outputs of (state, row) -> state, output for some rows: by a scan in JAX, so that it is compiled once."""
    if f is jnp:
        state = jax.tree.map(lambda number: jnp.asarray(number, float), state)
        columns = jnp.stack([jnp.stack([jnp.asarray(number, float) for number in row]) for row in rows])
        outputs = jax.lax.scan(step, state, columns)[1]
        return [jax.tree.map(lambda numbers, k=k: numbers[k], outputs) for k in range(len(rows))]
    outputs = []
    for row in rows:
        state, output = step(state, row)
        outputs.append(output)
    return outputs


def torques(f: Any, x: Any, qdd: Any) -> list[Any]:
    """The torques of accelerations, by Newton's and Euler's equations from the base to the tip."""

    def away(turn: Vector, spin: Vector, moved: Vector, r: Vector) -> Vector:
        return add(moved, add(cross(spin, r), cross(turn, cross(turn, r))))

    def pair(state: Any, row: Any) -> tuple[Any, Any]:
        frame, at, turn, spin, moved = state
        length, mass, side, ahead, *motion = [row[i] for i in range(10)]
        output = []
        for axis, i in (("z", 0), ("y", 1)):
            w = frame[2] if axis == "z" else frame[1]
            output.append((w, at))
            spin = add(spin, add(scaled(motion[4 + i], w), cross(turn, scaled(motion[2 + i], w))))
            turn = add(turn, scaled(motion[2 + i], w))
            frame = turned(frame, axis, f.cos(motion[i]), f.sin(motion[i]))
            if axis == "z":
                r = scaled(length, frame[2])
                moved, at = away(turn, spin, moved, r), add(at, r)
        r = add(scaled(side, frame[0]), scaled(ahead, frame[2]))
        force = scaled(mass, away(turn, spin, moved, r))
        return (frame, at, turn, spin, moved), (output, force, cross(add(at, r), force))

    # The last axis has no partner.
    motion = [[*(column[i] for i in range(7)), 0.0] for column in (x, [x[7 + i] for i in range(7)], qdd)]
    rows = [[*numbers, *(column[2 * k + i] for column in motion for i in (0, 1))] for k, numbers in enumerate(PAIRS)]
    base = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    # The base accelerates upwards: that is weight.
    start = base, [0.0] * 3, [0.0] * 3, [0.0] * 3, [0.0, 0.0, GRAVITY]
    tau, force, moment = [], [0.0] * 3, [0.0] * 3
    for axes, one, about in reversed(repeated(f, pair, start, rows)):
        force, moment = add(force, one), add(moment, about)
        tau += [dot(w, add(moment, scaled(-1, cross(at, force)))) for w, at in reversed(axes)]
    return tau[:0:-1]


def beyond_torques(f: Any, x: Any, qdd: Any) -> list[Any]:
    """Torques relative to their limits, less one, in both directions."""
    shares = [tau / limit for tau, limit in zip(torques(f, x, qdd), TORQUES, strict=True)]
    return [sign * share - 1 for sign in (1, -1) for share in shares]


def accelerated(f: Any, x: Any, u: Any) -> list[Any]:
    """Steps of 50 ms of seven joints whose accelerations are the controls."""
    h = 0.05
    return [x[i] + h * x[7 + i] + h**2 / 2 * u[i] for i in range(7)] + [x[7 + i] + h * u[i] for i in range(7)]
