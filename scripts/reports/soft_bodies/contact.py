"""Bodies that touch: scenes whose surfaces must never cross, checked exactly after every step.

Every case reports the steps that did not converge, the crossings of surfaces in rational arithmetic over all steps, the
smallest distance and the largest number of Newton iterations.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.rollout import rollout
from dln_jax.softbody.contact import body_contact, crossings, half_space, obstacle_contact
from dln_jax.softbody.integrators import AVERAGE_VECTOR_FIELD, BACKWARD_EULER, BDF2, Integrator
from dln_jax.softbody.mesh.mesh import Mesh, lumped_masses, make_mesh, vertices_where
from dln_jax.softbody.mesh.shapes import beam, box, disc
from dln_jax.softbody.scene import SoftScene, make_scene, potential, with_parameters
from dln_jax.softbody.step import make_step
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.gravity import gravity
from dln_jax.softbody.terms.strain_energies import stable_neo_hookean
from scripts.reports.case import Findings
from scripts.reports.rows import Row, expect, largest
from scripts.reports.soft_bodies.common import GRAVITY

DENSITY = 1000.0
STACK_STEP = 0.05
"""In s: long steps of backward Euler bring a stack to rest soon."""


def joined(*bodies: Mesh) -> Mesh:
    """Returns one mesh of several bodies."""
    starts = np.cumsum([0, *(len(body.vertices) for body in bodies)])
    elements = [body.elements + start for body, start in zip(bodies, starts, strict=False)]
    return make_mesh(np.concatenate([body.vertices for body in bodies]), np.concatenate(elements))


def moved(body: Mesh, *offset: float) -> Mesh:
    """Returns a mesh shifted by an offset in m."""
    return body._replace(vertices=body.vertices + np.array(offset))


def stack(quick: bool) -> Findings:
    """Five blocks (two in space) on a held one come to rest; the lowest joint carries the weight of all above it."""
    rows = _stack("stack/plane", 2, 5, 150 if quick else 400)
    return Findings(rows if quick else rows + _stack("stack/space", 3, 2, 600))


def folding_beam(quick: bool) -> Findings:
    """A soft strip, held on the left, falls onto itself and onto a shelf in a fold."""
    strip = beam(2.0, 0.05, 40, 1)
    shelf = moved(beam(1.0, 0.1, 10, 1), 0.2, -0.5)
    mesh = joined(strip, shelf)
    held = vertices_where(mesh, lambda x: (x[:, 0] == 0) | (x[:, 1] < -0.3))
    contact = body_contact(mesh, distance=0.01, stiffness=1e5, friction=0.2)
    scene = _scene(mesh, 2e5, contact, held=held)
    return Findings(_motion("folding-beam", scene, 0.01, 60 if quick else 200))


def impact(quick: bool) -> Findings:
    """A disc hits a held block at 100 m/s, where a step is twice the thickness of the block."""
    del quick
    target = beam(0.5, 2.0, 2, 8)
    mesh = joined(moved(disc(0.4, 4), -1.0, 1.0), target)
    contact = body_contact(mesh, distance=0.02, stiffness=1e7)
    scene = _scene(mesh, 1e7, contact, held=vertices_where(mesh, lambda x: x[:, 0] == 0.5), weight=False)
    v = np.where(mesh.vertices[:, :1] < -0.1, [100.0, 0.0], [0.0, 0.0])
    return Findings(_motion("impact-100-m/s", scene, 0.01, 40, v=v))


def sliding(quick: bool) -> Findings:
    """A block slides on a held one with 1 m/s and stops after v²/(2 mu g), to 5 %."""
    base, block = beam(2.0, 0.2, 20, 2), moved(beam(0.4, 0.2, 4, 2), 0.2, 0.21)
    mesh = joined(base, block)
    friction, speed = 0.3, 1.0
    contact = body_contact(mesh, distance=0.01, stiffness=1e5, friction=friction)
    scene = _scene(mesh, 5e6, contact, held=vertices_where(mesh, lambda x: x[:, 1] < 0.201))
    above = mesh.vertices[:, 1] > 0.203
    xs: list[np.ndarray] = []
    rows = _motion(
        "sliding", scene, 0.005, 100 if quick else 120, v=np.where(above[:, None], [speed, 0.0], 0.0), keep=xs
    )
    slid = float((xs[-1] - mesh.vertices)[above, 0].mean())
    expected = speed**2 / (2 * friction * GRAVITY)
    rows.append(expect("sliding", "relative_error_of_way", "v²/(2 mu g)", abs(slid / expected - 1), 0.05))
    return Findings(rows)


def ring(quick: bool) -> Findings:
    """A soft ball (a block) is pressed through a held ring that is narrower than it."""
    frame = [box((0.2, 0.2, 1.0), (1, 1, 3)), moved(box((0.2, 0.2, 1.0), (1, 1, 3)), 0.9, 0.0, 0.0)]
    frame += [moved(box((0.7, 0.2, 0.2), (2, 1, 1)), 0.2, 0.0, z) for z in (-0.23, 1.03)]
    ball = moved(box((0.75, 0.75, 0.75), (3, 3, 3)), 0.175, 0.23, 0.125)
    mesh = joined(*frame, ball)
    held = vertices_where(mesh, lambda x: x[:, 1] < 0.21)
    contact = body_contact(mesh, distance=0.02, stiffness=1e5)
    scene = _scene(mesh, 2e4, contact, held=held, weight=False)
    v = np.where(mesh.vertices[:, 1:2] > 0.21, [0.0, -4.0, 0.0], 0.0)
    return Findings(_motion("ball-through-ring", scene, 0.01, 20 if quick else 60, v=v))


def twisted_bar(quick: bool) -> Findings:
    """A bar is twisted by its held ends until it meets itself."""
    mesh = box((0.2, 2.0, 0.2), (1, 10, 1))
    held = vertices_where(mesh, lambda x: (x[:, 1] == 0) | (x[:, 1] == 2.0))
    scene = _scene(mesh, 1e6, body_contact(mesh, distance=0.01, stiffness=1e5), held=held, weight=False)
    dt, turns = 0.02, 1.0 if quick else 3.0
    steps = 50 if quick else 150
    upper = mesh.vertices[held, 1] > 1

    def path(t: float) -> np.ndarray:
        angle = np.where(upper, 2 * np.pi * turns * t / (steps * dt), 0.0)
        x, y, z = (mesh.vertices[held] - [0.1, 0.0, 0.1]).T
        lower = np.where(upper, -0.6 * t / (steps * dt), 0.0)
        around = np.stack([np.cos(angle) * x - np.sin(angle) * z, np.sin(angle) * x + np.cos(angle) * z])
        return np.stack([0.1 + around[0], y + lower, 0.1 + around[1]], axis=1)

    return Findings(_motion("twisted-bar", scene, dt, steps, path=path))


def gripper(quick: bool) -> Findings:
    """Two held jaws close on a disc and lift it by friction."""
    jaws = [moved(beam(0.2, 0.6, 2, 6), -0.75, -0.3), moved(beam(0.2, 0.6, 2, 6), 0.55, -0.3)]
    mesh = joined(*jaws, disc(0.4, 4))
    held = vertices_where(mesh, lambda x: abs(x[:, 0]) > 0.7)
    scene = _scene(mesh, 3e5, body_contact(mesh, distance=0.01, stiffness=1e5, friction=0.8), held=held)
    dt, steps = 0.005, 160
    rest = mesh.vertices[held]

    def path(t: float) -> np.ndarray:
        close = 0.22 * min(t / 0.08, 1.0)
        lift = 0.6 * max(0.0, t - 0.12)
        return rest + np.stack([-np.sign(rest[:, 0]) * close, np.full(len(rest), lift)], axis=1)

    xs: list[np.ndarray] = []
    rows = _motion("gripper", scene, dt, steps, path=path, keep=xs)
    ball = np.arange(len(mesh.vertices)) >= 2 * len(jaws[0].vertices)
    lifted = float((xs[-1] - mesh.vertices)[ball, 1].mean())
    text = "the ball rises with the jaws, by 0.41 m"
    rows.append(expect("gripper", "lifted", text, lifted, 0.25, unit="m", at_least=True))
    del quick
    return Findings(rows)


def bounce(quick: bool) -> Findings:
    """An elastic ball hits the ground at 2 m/s, without gravity: its energy after the rebound, and its restitution.

    The exact motion keeps the energy. The ball rebounds more slowly than it came, because it vibrates afterwards.
    """
    ball = moved(disc(0.5, 3), 0.0, 0.53)
    material = elastic(ball, stable_neo_hookean, youngs_modulus=3e5, poisson_ratio=0.3)
    ground = obstacle_contact(ball, half_space([0.0, 1.0]), distance=0.02, stiffness=1e5)
    scene = make_scene(ball, [material], masses=lumped_masses(ball, DENSITY), contacts=[ground])
    masses, seconds, speed = np.asarray(scene.params.masses), 0.3, 2.0
    brought = 0.5 * masses.sum() * speed**2

    def rebound(integrator: Integrator, dt: float) -> tuple[float, float, int]:
        """Lost share of the energy, restitution, and the number of steps that did not converge."""
        init, step = make_step(scene, dt, integrator, tolerance=1e-8)
        program = jax.jit(
            lambda state: rollout(
                partial(step, scene.params), state, steps=round(seconds / dt), observe=lambda _, info: info.converged
            )
        )
        state, converged = program(init(v=[0.0, -speed]))
        kinetic = 0.5 * float(masses @ np.sum(np.asarray(state.v) ** 2, axis=1))
        lost = 1 - (kinetic + float(potential(scene, state.x, scene.params))) / brought
        return lost, float(masses @ np.asarray(state.v)[:, 1]) / masses.sum() / speed, int((~converged).sum())

    exact, rows, failed = rebound(AVERAGE_VECTOR_FIELD, 1e-3 if quick else 2e-4)[1], [], 0
    for name, integrator in (("backward-euler", BACKWARD_EULER), ("bdf2", BDF2)):
        before = 1.0
        for dt in (2e-3, 1e-3) if quick else (2e-3, 1e-3, 5e-4):
            lost, restitution, count = rebound(integrator, dt)
            failed += count
            case = f"bounce/{name}/{1e3 * dt:g}-ms"
            rows.append(expect(case, "lost_energy", "less than in steps twice as long", lost, before))
            text = f"that of short steps, {exact:.4f}"
            rows.append(expect(case, "error_of_restitution", text, abs(restitution / exact - 1), 0.15))
            before = lost
    for dt in (1e-2, 5e-3, 1e-3):
        lost, restitution, count = rebound(AVERAGE_VECTOR_FIELD, dt)
        failed += count
        case = f"bounce/average-vector-field/{1e3 * dt:g}-ms"
        rows.append(expect(case, "error_of_energy", "the energy is kept", abs(lost), 1e-3))
        text = f"that of short steps, {exact:.4f}"
        rows.append(expect(case, "error_of_restitution", text, abs(restitution / exact - 1), 0.05))
    rows.append(expect("bounce", "steps_not_converged", "every step converges", failed, 0.0))
    return Findings(rows)


def gradients(quick: bool) -> Findings:
    """Derivative of a motion with friction by Young's modulus and by the barrier's stiffness, against differences."""
    scene = _stacked(2, 2, friction=0.3)
    init, step = make_step(scene, 0.01, tolerance=1e-10)

    def outcome(values: jax.Array) -> jax.Array:
        elastic = {"youngs_modulus": values[0]}
        params = with_parameters(scene.params, elastic=elastic, contact={"stiffness": values[1]})
        end, _ = jax.lax.scan(
            lambda state, _: (step(params, state, None)[0], None), init(), None, length=20 if quick else 60
        )
        return jnp.sum(end.x[:, -1] ** 2) + 0.1 * jnp.sum(end.v[:, 0])

    at = jnp.array([2e6, 1e5])
    gradient = jax.jit(jax.grad(outcome))(at)
    value = jax.jit(outcome)
    rows = []
    for place, name in enumerate(("youngs-modulus", "stiffness")):
        change = 10.0 * np.eye(2)[place]
        difference = (value(at + change) - value(at - change)) / 20.0
        error = abs(gradient[place] / difference - 1)
        rows.append(expect(f"gradient/{name}", "relative_error", "central differences", error, 1e-6))
    return Findings(rows)


def _stacked(dimension: int, count: int, friction: float | None) -> SoftScene:
    block = beam(1.0, 0.5, 4, 2) if dimension == 2 else box((1.0, 1.0, 0.5), (3, 3, 2))
    up, along = np.eye(dimension)[-1], np.eye(dimension)[0]
    mesh = joined(*(moved(block, *(0.51 * k * up + 0.07 * (k % 2) * along)) for k in range(count + 1)))
    low = vertices_where(mesh, lambda x: x[:, -1] < 0.505)
    return _scene(mesh, 2e6, body_contact(mesh, distance=0.02, stiffness=1e5, friction=friction), held=low)


def _stack(name: str, dimension: int, count: int, steps: int) -> list[Row]:
    scene = _stacked(dimension, count, friction=0.5)
    xs: list[np.ndarray] = []
    rows = _motion(name, scene, STACK_STEP, steps, keep=xs)
    force = _force_on_held(scene, xs[-1])
    weight = float(np.asarray(scene.params.masses)[scene.free[:, 0]].sum()) * GRAVITY
    rows.append(expect(name, "relative_error_of_force", "weight of the blocks", abs(force / weight - 1), 1e-6))
    return rows


def _force_on_held(scene: SoftScene, x: np.ndarray) -> float:
    """Vertical force in N of the barrier on the held body."""
    from dln_jax.softbody.scene import contact_energies, prepare_contacts
    from dln_jax.solvers.elements.moving import lists_between, moving_gradient

    at = jnp.asarray(x)
    barrier, data = contact_energies(scene)[:1], prepare_contacts(scene, scene.params, at)[:1]
    _, gradient = moving_gradient(barrier, at, lists_between(barrier, at, jnp.zeros_like(at), data), data)
    return float(gradient[scene.held, -1].sum())


def _scene(mesh: Mesh, modulus: float, contact: Any, *, held: np.ndarray, weight: bool = True) -> SoftScene:
    terms = [elastic(mesh, stable_neo_hookean, youngs_modulus=modulus, poisson_ratio=0.3)]
    if weight:
        terms.append(gravity(mesh, -GRAVITY * np.eye(mesh.dimension)[-1]))
    return make_scene(mesh, terms, masses=lumped_masses(mesh, DENSITY), held=held, contacts=[contact])


def _motion(
    name: str,
    scene: SoftScene,
    dt: float,
    steps: int,
    *,
    v: Any = 0.0,
    path: Callable[[float], np.ndarray] | None = None,
    keep: list[np.ndarray] | None = None,
) -> list[Row]:
    """Rows of a motion; all positions are appended to `keep`."""
    init, step = make_step(scene, dt)
    state = init(v=v)
    program = jax.jit(step).lower(scene.params, state).compile()
    failed, crossed, iterations, distances = 0, 0, [], []
    for number in range(steps):
        if path is not None:
            velocity = (path((number + 1) * dt) - path(number * dt)) / dt
            state = state._replace(v=state.v.at[scene.held].set(velocity))
        state, info = program(scene.params, state)
        failed += not bool(info.converged)
        crossed += len(crossings(scene.mesh, np.asarray(state.x)))
        iterations.append(int(info.iterations))
        distances.append(float(info.least_distance))
        if keep is not None:
            keep.append(np.asarray(state.x))
    return [
        expect(name, "steps_not_converged", "every step converges, or says that it has not", failed, 0.0),
        expect(name, "crossings", "none, in rational arithmetic", crossed, 0.0),
        expect(name, "least_distance", "more than nothing", min(distances), 0.0, unit="m", at_least=True),
        expect(name, "most_iterations", "fewer than the solver allows", largest(iterations), 100.0),
    ]
