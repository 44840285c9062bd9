"""Invariants that a time step keeps or loses, its order, and Coulomb friction of a block on a plane.

The midpoint rule keeps every quadratic invariant, such as angular momentum. Source: Hairer, Lubich and Wanner,
"Geometric Numerical Integration" (2006), section IV.2.

A block of speed v stops after v²/(2 mu g); by backward Euler after the sum of h (v - n mu g h) while that is positive,
which is v h/2 less to first order. On a slope of tan = 0.5 it stays for mu >= 0.5, to the threshold speed below which
friction is smooth, and slides with g (sin - mu cos) for less.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.softbody.integrators import INTEGRATORS, Integrator
from dln_jax.softbody.mesh.mesh import Mesh
from dln_jax.softbody.mesh.shapes import beam
from dln_jax.softbody.scene import SoftScene, make_scene, potential, with_parameters
from dln_jax.softbody.step import make_step
from dln_jax.softbody.terms.contact import plane_contact
from dln_jax.softbody.terms.gravity import gravity
from dln_jax.softbody.terms.springs import springs
from scripts.reports.case import Findings
from scripts.reports.rows import expect, largest
from scripts.reports.soft_bodies.common import GRAVITY, converges, motion, solid

TOLERANCE = 1e-9
"""Tolerance of the steps, m/s²: exact properties of the method then hold to rounding."""
ORDERS = {"backward-euler": 1, "bdf2": 2, "midpoint": 2, "average-vector-field": 2}
DURATION = 1.0
"""Length of the swing for measuring orders, s."""
SWING = np.array([[0.0, 0.0], [0.0, 1.0], [0.5, -1.0]])
"""Velocities at its start, in m/s."""
STIFFNESS = 1e6
"""Stiffness of the ground, N/m."""
MASS = 10.0
THRESHOLD = 1e-4
"""Friction is smooth below this speed, m/s."""
SPEED, FRICTION, SLOPE = 1.0, 0.3, 0.5


def invariants(quick: bool) -> Findings:
    """A free body that turns and wobbles: momentum, angular momentum, energy."""
    rows = []
    for integrator in ("backward-euler", "midpoint"):
        scene = solid(beam(1.0, 0.25, 4, 1), modulus=1e5)
        init, step = make_step(scene, 0.01, INTEGRATORS[integrator], tolerance=TOLERANCE)
        params = with_parameters(scene.params, gravity={"acceleration": np.zeros(2)})
        start = init(v=_turning(scene))
        seen = motion(step, 50)(params, start)
        x, v = np.concatenate([start.x[None], seen.x]), np.concatenate([start.v[None], seen.v])
        masses = np.asarray(params.masses)
        momentum = np.einsum("n,tnd->td", masses, v)
        turning = np.einsum("n,tn->t", masses, x[..., 0] * v[..., 1] - x[..., 1] * v[..., 0])
        stored = jax.jit(jax.vmap(lambda x, scene=scene, params=params: potential(scene, x, params)))(jnp.asarray(x))
        energy = 0.5 * np.einsum("n,tnd->t", masses, v**2) + np.asarray(stored)
        name = f"free-body/{integrator}"
        drift = largest(abs(momentum - momentum[0])) / float(np.sum(masses[:, None] * abs(v[0])))
        rows += converges(name, seen.converged)
        rows.append(expect(name, "momentum_drift", "internal forces sum to zero: exact to rounding", drift, 1e-12))
        if integrator == "midpoint":
            text = "a quadratic invariant: exact to the tolerance of the steps"
            drift = largest(abs((turning - turning[0]) / turning[0]))
            rows.append(expect(name, "angular_momentum_drift", text, drift, 1e-9))
            text = "no drift: the energy stays within the step's error of second order"
            rows.append(expect(name, "largest_energy_error", text, largest(abs(energy / energy[0] - 1)), 0.02))
            continue
        text, rise = "it dissipates: the energy rises in no step, to rounding", largest(np.diff(energy)) / energy[0]
        rows.append(expect(name, "largest_energy_rise", text, rise, 1e-12))
        text = "it damps rotation too: angular momentum grows in no step, to rounding"
        rise = largest(np.diff(turning) / turning[0])
        rows.append(expect(name, "largest_angular_momentum_rise", text, rise, 1e-12))
    return Findings(rows)


def orders(quick: bool) -> Findings:
    """Errors of a swing of two masses on springs against an explicit method with tiny steps."""
    counts = (200, 400) if quick else (100, 200, 400)
    mesh = Mesh(np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]), np.zeros((0, 3), int))
    pulls = springs([[0, 1], [1, 2]], stiffness=[100.0, 60.0], rest_length=[1.0, 1.0])
    scene = make_scene(mesh, [pulls, gravity(mesh, (0.0, -GRAVITY))], masses=[1.0, 1.0, 0.7], held=[0])
    rows, reference = [], _reference_swing(scene)
    for name, integrator in INTEGRATORS.items():

        @jax.jit  # one program for every step length
        def end(count: Any, integrator: Integrator = integrator) -> Any:
            init, step = make_step(scene, DURATION / count, integrator, tolerance=TOLERANCE)
            return jax.lax.fori_loop(0, count, lambda _, state: step(scene.params, state, None)[0], init(v=SWING)).x

        errors = [largest(abs(np.asarray(end(count)) - reference)) for count in counts]
        order, expected = np.log2(errors[-2] / errors[-1]), float(ORDERS[name])
        text = f"order {ORDERS[name]} between {counts[-2]} and {counts[-1]} steps, against RK4 in NumPy"
        rows.append(expect(f"order/{name}", "order_error", text, abs(order - expected), 0.15, reference=expected))
    return Findings(rows)


def block(quick: bool) -> Findings:
    """Distance and steps until a block stops, and its limit for short steps."""
    distance = SPEED**2 / (2 * FRICTION * GRAVITY)
    scene = _block(np.array([0.0, 1.0]), FRICTION)
    rows = []
    for rate in (30,) if quick else (30, 300, 3000):
        h = 1 / rate
        init, step = make_step(scene, h)
        seen = motion(step, round(0.4 * rate))(scene.params, init(*_resting(scene, speed=SPEED)))
        speeds = SPEED - FRICTION * GRAVITY * h * np.arange(1, rate)
        exact = h * float(speeds[speeds > 0].sum())
        travelled = float(seen.x[-1, 0, 0] - scene.mesh.vertices[0, 0])
        name = f"block/{rate}-steps-per-second"
        text = "the method's own sum; smooth friction adds up to a threshold speed's way"
        error = abs(travelled - exact)
        rows.append(expect(name, "distance_error", text, error, 3 * THRESHOLD * h, "m", reference=exact))
        text = f"first order: {distance:.6f} m less v h/2"
        error = abs(travelled - distance)
        rows.append(expect(name, "distance_to_the_limit", text, error, SPEED * h / 2, "m", reference=distance))
        if rate == 30:
            stopped = 1 + int(np.argmax(np.abs(seen.v[:, 0, 0]) < THRESHOLD * 10))
            text = "it stands at the end of step 11"
            rows.append(expect(name, "steps_off", text, abs(stopped - 11), 0.0, reference=11.0))
            error = abs(travelled - 0.153667)
            rows.append(expect(name, "published_distance_error", "0.153667 m, published", error, 5e-6, "m"))
    return Findings(rows)


def slope(quick: bool) -> Findings:
    """A block on a slope of tan = 0.5 that just sticks, and one that just slides."""
    h, steps = 1 / 30, 60
    normal = np.array([-SLOPE, 1.0]) / np.hypot(SLOPE, 1.0)
    along = np.array([normal[1], -normal[0]])
    scene = _block(normal, 0.5)
    init, step = make_step(scene, h)
    run = motion(step, steps)
    rows = []
    for friction in (0.5, 0.49):
        seen = run(with_parameters(scene.params, ground={"friction": friction}), init(*_resting(scene)))
        downhill = -(seen.v[:, 0] @ along)
        name = f"slope/friction-{friction}"
        rows += converges(name, seen.converged)
        if friction == SLOPE:
            text = "it sticks: no faster than the threshold speed"
            rows.append(expect(name, "largest_speed", text, largest(abs(downhill)), THRESHOLD * (1 + 1e-6), "m/s"))
            continue
        exact = GRAVITY * (SLOPE - friction) / np.hypot(SLOPE, 1.0)
        measured = (downhill[-1] - downhill[steps // 2 - 1]) / (steps // 2 * h)
        text = "g (sin - mu cos): 0.0877 m/s²"
        error = abs(measured / exact - 1)
        rows.append(expect(name, "acceleration_error", text, error, 1e-6, reference=float(exact)))
    return Findings(rows)


def _turning(scene: SoftScene) -> np.ndarray:
    """Rotation about the centre and a bending of the body, with some speed on top; in m/s."""
    x = scene.mesh.vertices - scene.mesh.vertices.mean(axis=0)
    bending = np.stack([np.zeros(len(x)), 8.0 * (x[:, 0] ** 2 - 0.1)], axis=1)
    return np.stack([-x[:, 1], x[:, 0]], axis=1) * 3.0 + bending + np.array([0.5, 0.2])


def _reference_swing(scene: SoftScene) -> np.ndarray:
    """The last positions by RK4 in 20,000 steps, written in NumPy."""
    stiffness, length = (np.asarray(leaf) for leaf in scene.params.terms["springs"])
    masses = np.asarray(scene.params.masses)

    def rate(y: np.ndarray) -> np.ndarray:
        d = np.diff(y[0], axis=0)
        distance = np.linalg.norm(d, axis=1)
        pull = (stiffness * (distance - length) / distance)[:, None] * d
        force = np.zeros_like(y[0])
        force[:-1] += pull
        force[1:] -= pull
        acceleration = force / masses[:, None] + np.array([0.0, -GRAVITY])
        acceleration[0] = 0.0
        return np.stack([y[1], acceleration])

    y, count = np.stack([scene.mesh.vertices, SWING]), 20_000
    h = DURATION / count
    for _ in range(count):
        a = rate(y)
        b = rate(y + h / 2 * a)
        c = rate(y + h / 2 * b)
        y = y + h / 6 * (a + 2 * b + 2 * c + rate(y + h * c))
    return y[0]


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
