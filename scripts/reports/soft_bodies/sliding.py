"""Coulomb friction of a block on a plane.

A block of speed v stops after v²/(2 mu g); by backward Euler after the sum of h (v - n mu g h) while that is positive,
which is v h/2 less to first order. On a slope of tan = 0.5 it stays for mu >= 0.5, to the threshold speed below which
friction is smooth, and slides with g (sin - mu cos) for less.
"""

import numpy as np

from dln_jax.softbody.mesh.mesh import Mesh
from dln_jax.softbody.scene import SoftScene, make_scene, with_parameters
from dln_jax.softbody.step import make_step
from dln_jax.softbody.terms.contact import plane_contact
from dln_jax.softbody.terms.gravity import gravity
from scripts.reports.case import Findings
from scripts.reports.rows import expect, largest
from scripts.reports.soft_bodies.common import GRAVITY, converges, motion

STIFFNESS = 1e6
"""Stiffness of the ground, N/m."""
MASS = 10.0
THRESHOLD = 1e-4
"""Speed below which friction is smooth, m/s."""
SPEED = 1.0
FRICTION = 0.3
SLOPE = 0.5


def block(quick: bool) -> Findings:
    """Distance and steps until a block stops, and its limit for short steps."""
    distance = SPEED**2 / (2 * FRICTION * GRAVITY)
    scene = _block(np.array([0.0, 1.0]), FRICTION)
    cases = []
    for rate in (30, 300) if quick else (30, 300, 3000):
        h = 1 / rate
        init, step = make_step(scene, h)
        seen = motion(step, round(0.4 * rate))(scene.params, init(*_resting(scene, speed=SPEED)))
        speeds = SPEED - FRICTION * GRAVITY * h * np.arange(1, rate)
        exact = h * float(speeds[speeds > 0].sum())
        gone = float(seen.x[-1, 0, 0] - scene.mesh.vertices[0, 0])
        stopped = 1 + int(np.argmax(np.abs(seen.v[:, 0, 0]) < THRESHOLD * 10))
        name = f"block/{rate}-steps-per-second"
        text = "the method's own sum; smooth friction adds up to a threshold speed's way"
        error = abs(gone - exact)
        cases.append(expect(name, "distance_error", text, error, 3 * THRESHOLD * h, "m", reference=exact))
        text = f"first order: {distance:.6f} m less v h/2"
        error = abs(gone - distance)
        cases.append(expect(name, "distance_to_the_limit", text, error, SPEED * h / 2, "m", reference=distance))
        if rate == 30:
            late = float(abs(stopped - 11))
            cases.append(expect(name, "steps_off", "it stands at the end of step 11", late, 0.0, reference=11.0))
            text = "0.153667 m, published"
            cases.append(expect(name, "published_distance_error", text, abs(gone - 0.153667), 5e-6, "m"))
    return Findings(cases)


def slope(quick: bool) -> Findings:
    """A block on a slope of tan = 0.5 that just sticks, and one that just slides."""
    h, steps = 1 / 30, 60
    normal = np.array([-SLOPE, 1.0]) / np.hypot(SLOPE, 1.0)
    along = np.array([normal[1], -normal[0]])
    scene = _block(normal, 0.5)
    init, step = make_step(scene, h)
    run = motion(step, steps)
    cases = []
    for friction in (0.5, 0.49):
        seen = run(with_parameters(scene.params, ground={"friction": friction}), init(*_resting(scene)))
        downhill = -(seen.v[:, 0] @ along)
        name = f"slope/friction-{friction}"
        cases.append(converges(name, seen.converged))
        if friction == SLOPE:
            text = "it sticks: no faster than the threshold speed"
            cases.append(expect(name, "largest_speed", text, largest(abs(downhill)), THRESHOLD * (1 + 1e-6), "m/s"))
            continue
        exact = GRAVITY * (SLOPE - friction) / np.hypot(SLOPE, 1.0)
        got = (downhill[-1] - downhill[steps // 2 - 1]) / (steps // 2 * h)
        text = "g (sin - mu cos): 0.0877 m/s²"
        cases.append(expect(name, "acceleration_error", text, abs(got / exact - 1), 1e-6, reference=float(exact)))
    return Findings(cases)


def _block(normal: np.ndarray, friction: float) -> SoftScene:
    """Two particles, since a block that only translates is a particle; two, so that neither is special."""
    mesh = Mesh(np.outer([0.0, 1.0], [normal[1], -normal[0]]), np.zeros((0, 3), int))
    ground = plane_contact(
        [0, 1], normal=normal, stiffness=STIFFNESS, width=0.0, friction=friction, threshold_speed=THRESHOLD
    )
    return make_scene(mesh, [gravity(mesh, (0.0, -GRAVITY)), ground], masses=MASS)


def _resting(scene: SoftScene, speed: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Positions at the depth where the ground carries the weight, and velocities."""
    normal = np.asarray(scene.params.terms["ground"].normal)
    depth = MASS * GRAVITY * normal[1] / STIFFNESS
    return scene.mesh.vertices - depth * normal, speed * np.array([normal[1], -normal[0]])
