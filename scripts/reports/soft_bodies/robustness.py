"""Hard cases for solvers: long steps, stiff and nearly incompressible bodies, bad starts, uneven masses, large twists.

Every case checks that all steps report convergence, and a result: Newton iterations, the smallest J = det F over all
elements, or the difference between two precisions.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.softbody.mesh.mesh import Mesh, vertices_where
from dln_jax.softbody.mesh.shapes import beam, box
from dln_jax.softbody.mesh.simplices import simplex_volumes
from dln_jax.softbody.scene import Params, State, make_scene, with_parameters
from dln_jax.softbody.step import make_step
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.gravity import gravity
from dln_jax.softbody.terms.springs import springs
from dln_jax.softbody.terms.strain_energies import stable_neo_hookean
from dln_jax.softbody.verdict import Info
from scripts.reports.case import Findings
from scripts.reports.rows import Row, expect, largest
from scripts.reports.soft_bodies.common import GRAVITY, Seen, cantilever_of, converges, motion

DT = 1 / 30
STEPS = 60
"""Steps of a motion of 2 s."""


def time_steps(quick: bool) -> Findings:
    """The first steps from rest, of 1 ms to 10 s, of a beam that falls under its weight."""
    scene = _beam(quick)[0]
    rows = []
    for dt in (10.0,) if quick else (1e-3, 1e-2, 1e-1, 1.0, 10.0):
        init, step = make_step(scene, dt)
        found = motion(step, 3)(scene.params, init())
        rows += _converged(f"time-step/{dt:g}-s", found, 12, "2 to 12 Newton iterations, from rest")
    return Findings(rows)


def materials(quick: bool) -> Findings:
    """Two seconds of a beam from soft to stiff and from compressible to nearly incompressible, by one program."""
    scene, init, run = _beam(quick)
    cases = []
    table = [(f"modulus/{modulus:.0e}", modulus, 0.3) for modulus in (1e4, 1e6, 1e8, 1e10)]
    table += [(f"poisson/{ratio}", 1e6, ratio) for ratio in (0.4, 0.49, 0.4999)]
    for name, modulus, ratio in table:
        found = run(with_parameters(scene.params, elastic={"youngs_modulus": modulus, "poisson_ratio": ratio}), init())
        most = largest(found.iterations[:3])
        text = "3 to 4 Newton iterations in a prototype, in the first steps from rest"
        cases += _converged(name, found, 100, f"below what the solver allows, in {STEPS} steps")
        cases.append(expect(name, "most_iterations_at_first", text, most, 12.0))
    return Findings(cases)


def bad_starts(quick: bool) -> Findings:
    """Meshes that are scrambled, or collapsed to a point or a line, under their weight: they recover in a few steps."""
    scene, init, run = _beam(quick)
    rest = scene.mesh.vertices
    starts = {
        "scrambled": np.random.default_rng(0).uniform(rest.min(axis=0), rest.max(axis=0), rest.shape),
        "point-collapsed": np.broadcast_to(rest.mean(axis=0), rest.shape),
        "line-collapsed": rest * np.array([1.0, 0.0]) + np.array([0.0, 0.5]),
    }
    cases, curves = [], {}
    for name, x in starts.items():
        found = run(scene.params, init(np.where(scene.free, x, rest)))
        # Elements are inverted at the start, and steps with inverted elements do not count as converged.
        curves[name] = _least_J(scene.mesh, found.x)
        upright = curves[name] > 0
        recovered = found._replace(converged=found.converged | ~upright)
        cases += _converged(f"start/{name}", recovered, 100, "below what the solver allows")
        text = "no element is inverted in the end (a prototype: 0.779)"
        cases.append(expect(f"start/{name}", "least_J", text, curves[name][-1], 0.0, at_least=True))
    return Findings(cases, curves)


def mass_ratio(quick: bool) -> Findings:
    """Vertices that are 1e4 times heavier than their neighbours, in turn."""
    scene, init, run = _beam(quick)
    # More weight would invert elements, which would not be the solver's fault.
    heavy = np.where(np.arange(len(scene.mesh.vertices)) % 2, 1e2, 1e-2)
    stiffer = with_parameters(scene.params, elastic={"youngs_modulus": 1e7})
    found = run(stiffer._replace(masses=jnp.asarray(heavy)), init())
    return Findings(_converged("mass-ratio/1e4", found, 20, "a few more than with even masses"))


def chain(quick: bool) -> Findings:
    """A chain of 100 springs, released from level, with an end mass 1e4 times that of a link."""
    links = 100
    mesh = Mesh(np.stack([np.linspace(0.0, 10.0, links + 1), np.zeros(links + 1)], axis=1), np.zeros((0, 3), int))
    pairs = np.stack([np.arange(links), np.arange(1, links + 1)], axis=1)
    masses = np.append(np.full(links, 0.01), 100.0)
    terms = [springs(pairs, stiffness=1e7), gravity(mesh, (0.0, -GRAVITY))]
    scene = make_scene(mesh, terms, masses=masses, held=[0])
    init, step = make_step(scene, DT)
    found = motion(step, 60)(scene.params, init())
    stretch = np.linalg.norm(np.diff(found.x, axis=1), axis=2).sum(axis=1) / 10.0
    text = "the springs stretch by the load over their stiffness: 3 m g (the fall's pull) over 1e7 N/m, doubled"
    bound = 2 * 3 * 101 * GRAVITY / (1e7 * 0.1)
    rows = _converged("chain/100-springs", found, 30, "from level, where springs resist no sideways motion")
    return Findings([*rows, expect("chain/100-springs", "largest_stretch", text, largest(abs(stretch - 1)), bound)])


def twist(quick: bool) -> Findings:
    """A bar with one end turned about its axis; its held vertices move with prescribed velocities."""
    cells, turns, steps = ((8, 1, 1), 1.0, 30) if quick else ((32, 4, 4), 3.0, 90)
    mesh = box((4.0, 0.5, 0.5), cells)
    left = vertices_where(mesh, lambda x: x[:, 0] == 0)
    right = vertices_where(mesh, lambda x: x[:, 0] == 4.0)
    material = elastic(mesh, stable_neo_hookean, youngs_modulus=1e5, poisson_ratio=0.4)
    scene = make_scene(mesh, [material], held=np.concatenate([left, right]))
    init, step = make_step(scene, DT)
    angle = 2 * np.pi * turns / steps

    def turned(params: Params, state: State, control: Any) -> tuple[State, Info]:
        y, z = state.x[right, 1] - 0.25, state.x[right, 2] - 0.25
        c, s = np.cos(angle), np.sin(angle)
        change = jnp.stack([jnp.zeros_like(y), (c - 1) * y - s * z, s * y + (c - 1) * z], axis=1)
        return step(params, state._replace(v=state.v.at[right].set(change / DT)), control)

    found = motion(turned, steps)(scene.params, init())
    least = _least_J(mesh, found.x)
    text = "no element inverts on the way, turned by less than 45 degrees per cell"
    shown = np.linspace(0, steps - 1, 4).round().astype(int)
    t = DT * (shown + 1)
    curves = {"mesh": mesh, "x": found.x[shown], "t": t, "turns": turns * t / (DT * steps)}
    name = f"twist/{turns:g}-turns"
    rows = _converged(name, found, 30, "a bar of constant strain tetrahedra")
    return Findings([*rows, expect(name, "least_J", text, least.min(), 0.0, at_least=True)], curves)


def float32(quick: bool) -> Findings:
    """A beam that swings, in float32 and in float64."""
    scene, init, run = _beam(quick)
    double = run(scene.params, init())
    single = run(*jax.tree.map(lambda leaf: leaf.astype(jnp.float32), (scene.params, init())))
    moved = largest(abs(double.x - scene.params.rest))
    difference = largest(abs(single.x.astype(np.float64) - double.x)) / moved
    text = f"{STEPS} steps in float32 differ from float64 by less than 1e-3 of the motion"
    rows = _converged("float32", single, 20, "the line search accepts what rounding hides")
    return Findings([*rows, expect("float32", "relative_difference", text, difference, 1e-3)])


def not_converged(quick: bool) -> Findings:
    """A solver limited to one Newton step: it reports that it has not converged, and the gradient is NaN."""
    scene = cantilever_of(beam(1.0, 0.25, 4, 1), modulus=1e4)
    init, step = make_step(scene, 0.1, iterations=1)

    def height(params: Params):
        state, info = step(params, init(), None)
        return state.x[-1, 1], info.converged

    (_, converged), slopes = jax.jit(jax.value_and_grad(height, has_aux=True))(scene.params)
    finite = sum(int(np.isfinite(leaf).sum()) for leaf in jax.tree.leaves(slopes.terms))
    rows = [
        expect("one-iteration", "reported_as_converged", "Info.converged is false", converged, 0.0),
        expect("one-iteration", "finite_derivatives", "by a material and gravity: all NaN", finite, 0.0),
    ]
    return Findings(rows)


@functools.cache
def _beam(quick: bool):
    """The scene, its `init`, and its motion of `STEPS` steps."""
    scene = cantilever_of(beam(4.0, 1.0, *((16, 4) if quick else (40, 10))))
    init, step = make_step(scene, DT)
    return scene, init, motion(step, STEPS)


def _converged(name: str, found: Seen, iterations: int, text: str) -> list[Row]:
    most = expect(name, "most_iterations", text, largest(found.iterations), iterations)
    return [converges(name, found.converged), most]


def _least_J(mesh: Mesh, x: Any) -> np.ndarray:
    """The smallest det F of all elements, after each step."""
    now = np.stack([simplex_volumes(np.asarray(at, np.float64), mesh.elements) for at in x])
    return (now / simplex_volumes(mesh.vertices, mesh.elements)).min(axis=1)
