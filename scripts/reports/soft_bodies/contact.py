"""Bodies that touch: scenes whose surfaces must never cross, in rational arithmetic, checked after every step."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.rollout import rollout
from dln_jax.softbody import (
    AVERAGE_VECTOR_FIELD,
    BACKWARD_EULER,
    BDF2,
    Integrator,
    SoftScene,
    make_scene,
    make_step,
    potential,
)
from dln_jax.softbody.contact import body_contact, crossings, half_space, obstacle_contact
from dln_jax.softbody.mesh import Mesh, beam, box, disc, lumped_masses, make_mesh, vertices_where
from dln_jax.softbody.scene import contact_energies, prepare_contacts
from dln_jax.softbody.terms import elastic, gravity, stable_neo_hookean
from dln_jax.solvers.elements.moving import lists_between, moving_gradient
from scripts.reports.run import Numbers

GRAVITY, DENSITY = 9.8, 1000.0


def joined(*bodies: Mesh) -> Mesh:
    """Returns one mesh of several bodies."""
    starts = np.cumsum([0, *(len(body.vertices) for body in bodies)])
    elements = [body.elements + start for body, start in zip(bodies, starts, strict=False)]
    return make_mesh(np.concatenate([body.vertices for body in bodies]), np.concatenate(elements))


def moved(body: Mesh, *offset: float) -> Mesh:
    """Returns a mesh shifted by an offset in m."""
    return body._replace(vertices=body.vertices + np.array(offset))


def scene_of(mesh: Mesh, modulus: float, contact: Any, held: np.ndarray, *, weight: bool = True) -> SoftScene:
    """Neo-Hookean bodies with nu = 0.3."""
    terms = [elastic(mesh, stable_neo_hookean, youngs_modulus=modulus, poisson_ratio=0.3)]
    if weight:
        terms.append(gravity(mesh, -GRAVITY * np.eye(mesh.dimension)[-1]))
    return make_scene(mesh, terms, masses=lumped_masses(mesh, DENSITY), held=held, contacts=[contact])


def moving(
    scene: SoftScene, dt: float, steps: int, *, v: Any = 0.0, path: Callable[[float], np.ndarray] | None = None
) -> tuple[dict[str, float], np.ndarray]:
    """Numbers of a motion whose held vertices follow a path, and its last positions."""
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
        iterations.append(float(info.iterations))
        distances.append(float(info.least_distance))
    numbers = {"steps_not_converged": failed, "crossings": crossed, "most_iterations": max(iterations)}
    return {**numbers, "least_distance_metres": min(distances)}, np.asarray(state.x)


def stack(*, stack_steps: int = 400) -> Numbers:
    """Five blocks on a held one come to rest, and press on it with their weight; long steps bring them to rest soon."""
    block = beam(1.0, 0.5, 4, 2)
    mesh = joined(*(moved(block, 0.07 * (k % 2), 0.51 * k) for k in range(6)))
    contact = body_contact(mesh, distance=0.02, stiffness=1e5, friction=0.5)
    scene = scene_of(mesh, 2e6, contact, vertices_where(mesh, lambda x: x[:, 1] < 0.505))
    numbers, x = moving(scene, 0.05, stack_steps)
    # The vertical force of the barrier on the held body.
    at = jnp.asarray(x)
    barrier, data = contact_energies(scene)[:1], prepare_contacts(scene, scene.params, at)[:1]
    _, gradient = moving_gradient(barrier, at, lists_between(barrier, at, jnp.zeros_like(at), data), data)
    force = float(gradient[scene.held, -1].sum())
    weight = float(np.asarray(scene.params.masses)[scene.free[:, 0]].sum()) * GRAVITY
    return {"stack/plane": {**numbers, "relative_error_of_force": abs(force / weight - 1)}}


def sliding(*, slide_steps: int = 120) -> Numbers:
    """A block slides on a held one with 1 m/s and stops after v²/(2 mu g)."""
    mesh = joined(beam(2.0, 0.2, 20, 2), moved(beam(0.4, 0.2, 4, 2), 0.2, 0.21))
    contact = body_contact(mesh, distance=0.01, stiffness=1e5, friction=0.3)
    scene = scene_of(mesh, 5e6, contact, vertices_where(mesh, lambda x: x[:, 1] < 0.201))
    above = mesh.vertices[:, 1] > 0.203
    numbers, x = moving(scene, 0.005, slide_steps, v=np.where(above[:, None], [1.0, 0.0], 0.0))
    slid = float((x - mesh.vertices)[above, 0].mean())
    return {"sliding": {**numbers, "relative_error_of_way": abs(slid * 2 * 0.3 * GRAVITY - 1)}}


def twisted_bar(*, turns: float = 3.0) -> Numbers:
    """A bar is twisted by its held ends until it meets itself, 50 steps of 20 ms a turn."""
    mesh, seconds = box((0.2, 2.0, 0.2), (1, 10, 1)), turns
    held = vertices_where(mesh, lambda x: (x[:, 1] == 0) | (x[:, 1] == 2.0))
    contact = body_contact(mesh, distance=0.01, stiffness=1e5)
    scene = scene_of(mesh, 1e6, contact, held, weight=False)
    upper = mesh.vertices[held, 1] > 1

    def path(t: float) -> np.ndarray:
        angle = np.where(upper, 2 * np.pi * turns * t / seconds, 0.0)
        x, y, z = (mesh.vertices[held] - [0.1, 0.0, 0.1]).T
        lower = np.where(upper, -0.6 * t / seconds, 0.0)
        around = np.stack([np.cos(angle) * x - np.sin(angle) * z, np.sin(angle) * x + np.cos(angle) * z])
        return np.stack([0.1 + around[0], y + lower, 0.1 + around[1]], axis=1)

    return {"twisted-bar": moving(scene, 0.02, round(50 * turns), path=path)[0]}


def bounce(*, milliseconds: tuple[float, ...] = (10.0, 5.0, 2.0, 1.0, 0.5, 0.2)) -> Numbers:
    """An elastic ball hits the ground at 2 m/s, without gravity: its energy after the rebound, and its restitution.

    The exact motion keeps the energy. The ball rebounds more slowly than it came, because it vibrates afterwards.
    """
    ball = moved(disc(0.5, 3), 0.0, 0.53)
    material = elastic(ball, stable_neo_hookean, youngs_modulus=3e5, poisson_ratio=0.3)
    ground = obstacle_contact(ball, half_space([0.0, 1.0]), distance=0.02, stiffness=1e5)
    scene = make_scene(ball, [material], masses=lumped_masses(ball, DENSITY), contacts=[ground])
    masses = np.asarray(scene.params.masses)
    integrators: dict[str, Integrator] = {
        "backward-euler": BACKWARD_EULER,
        "bdf2": BDF2,
        "average-vector-field": AVERAGE_VECTOR_FIELD,
    }
    numbers = {}
    for name, integrator in integrators.items():
        for step_ms in milliseconds:
            dt = 1e-3 * step_ms
            init, step = make_step(scene, dt, integrator, tolerance=1e-8)
            observe = lambda _, info: info.converged  # noqa: E731
            run = jax.jit(partial(rollout, partial(step, scene.params), steps=round(0.3 / dt), observe=observe))
            state, converged = run(init(v=[0.0, -2.0]))
            v = np.asarray(state.v)
            energy = 0.5 * float(masses @ np.sum(v**2, axis=1)) + float(potential(scene, state.x, scene.params))
            numbers[f"bounce/{name}/{step_ms:g}-ms"] = {
                "lost_energy": 1 - energy / (0.5 * masses.sum() * 2.0**2),
                "restitution": float(masses @ v[:, 1]) / masses.sum() / 2.0,
                "steps_not_converged": int((~converged).sum()),
            }
    return numbers
