"""A seven-axis arm for plans, its axes alternating between z and y, as formulas for JAX and for CasADi alike.

Masses are points: the motors of the elbow, the middle of the forearm, the wrist, and a tool beside the last axis.
"""

from typing import Any

GRAVITY = 9.81
LINKS = (0.34, 0.40, 0.40, 0.126)
"""Lengths between base, shoulder, elbow, wrist and tip, m."""
AXES = "zyzyzyz"
MASSES = ((2, 3.5, (0.0, 0.0, LINKS[1])), (4, 1.5, (0.0, 0.0, LINKS[2] / 2)), (4, 2.0, (0.0, 0.0, LINKS[2])),
          (7, 1.5, (0.05, 0.0, LINKS[3])))  # fmt: skip
"""Number of joints before a mass, kg, and its place in their frame, m."""
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


def placed(frame: list[Vector], place: Any) -> Vector:
    """A vector of a frame in the frame of the base."""
    x, y, z = (scaled(p, axis) for p, axis in zip(place, frame, strict=True))
    return add(add(x, y), z)


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


def torques(f: Any, x: Any, qdd: Any) -> list[Any]:
    """The torques of accelerations, by Newton's and Euler's equations from the base to the tip."""
    frame, at = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], [0.0, 0.0, 0.0]
    # The base accelerates upwards: that is weight.
    turn, spin, moved = [0.0] * 3, [0.0] * 3, [0.0, 0.0, GRAVITY]

    def away(r: Vector) -> Vector:
        return add(moved, add(cross(spin, r), cross(turn, cross(turn, r))))

    joints, loads = [], []
    for i, axis in enumerate(AXES):
        if i in (1, 3, 5):  # shoulder, elbow and wrist
            r = scaled(LINKS[i // 2], frame[2])
            moved, at = away(r), add(at, r)
        w = frame[2] if axis == "z" else frame[1]
        joints.append((w, at))
        spin = add(spin, add(scaled(qdd[i], w), cross(turn, scaled(x[7 + i], w))))
        turn = add(turn, scaled(x[7 + i], w))
        frame = turned(frame, axis, f.cos(x[i]), f.sin(x[i]))
        for number, mass, place in MASSES:
            if number == i + 1:
                r = placed(frame, place)
                force = scaled(mass, away(r))
                loads.append((i, force, cross(add(at, r), force)))
    tau = []
    for j, (w, at) in enumerate(joints):
        force, moment = [0.0] * 3, [0.0] * 3
        for i, one, about in loads:
            if i >= j:
                force, moment = add(force, one), add(moment, about)
        tau.append(dot(w, add(moment, scaled(-1, cross(at, force)))))
    return tau


def beyond_torques(f: Any, x: Any, qdd: Any) -> list[Any]:
    """Torques relative to their limits, less one, in both directions."""
    shares = [tau / limit for tau, limit in zip(torques(f, x, qdd), TORQUES, strict=True)]
    return [sign * share - 1 for sign in (1, -1) for share in shares]


def accelerated(f: Any, x: Any, u: Any) -> list[Any]:
    """Steps of 50 ms of seven joints whose accelerations are the controls."""
    h = 0.05
    return [x[i] + h * x[7 + i] + h**2 / 2 * u[i] for i in range(7)] + [x[7 + i] + h * u[i] for i in range(7)]
