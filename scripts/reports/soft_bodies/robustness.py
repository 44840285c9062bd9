"""Hard cases for solvers: long steps, stiff and nearly incompressible bodies, bad starts, uneven masses.

Every case checks that all steps report convergence, and a result: Newton iterations, or the smallest J = det F over all
elements.
"""

import functools
from typing import Any

import jax.numpy as jnp
import numpy as np

from dln_jax.softbody.mesh.mesh import Mesh
from dln_jax.softbody.mesh.shapes import beam
from dln_jax.softbody.mesh.simplices import simplex_volumes
from dln_jax.softbody.scene import make_scene, with_parameters
from dln_jax.softbody.step import make_step
from dln_jax.softbody.terms.gravity import gravity
from dln_jax.softbody.terms.springs import springs
from scripts.reports.case import Findings
from scripts.reports.rows import expect, largest
from scripts.reports.soft_bodies.common import GRAVITY, cantilever_of, converges, motion

DT = 1 / 30
STEPS = 60
"""Steps of a motion of 2 s."""
ALLOWED = "below what the solver allows"


def time_steps(quick: bool) -> Findings:
    """The first steps from rest, of 1 ms to 10 s, of a beam that falls under its weight."""
    scene = _beam(quick)[0]
    rows = []
    for dt in (10.0,) if quick else (1e-3, 1e-2, 1e-1, 1.0, 10.0):
        init, step = make_step(scene, dt)
        seen = motion(step, 3)(scene.params, init())
        text = "2 to 12 Newton iterations, from rest"
        rows += converges(f"time-step/{dt:g}-s", seen.converged, seen.iterations, 12, text)
    return Findings(rows)


def materials(quick: bool) -> Findings:
    """Two seconds of a beam from soft to stiff and from compressible to nearly incompressible, by one program."""
    scene, init, run = _beam(quick)
    rows = []
    table = [(f"modulus/{modulus:.0e}", modulus, 0.3) for modulus in (1e4, 1e6, 1e8, 1e10)]
    table += [(f"poisson/{ratio}", 1e6, ratio) for ratio in (0.4, 0.49, 0.4999)]
    for name, modulus, ratio in table:
        seen = run(with_parameters(scene.params, elastic={"youngs_modulus": modulus, "poisson_ratio": ratio}), init())
        rows += converges(name, seen.converged, seen.iterations, 100, f"{ALLOWED}, in {STEPS} steps")
        text = "3 to 4 Newton iterations in a prototype, in the first steps from rest"
        rows.append(expect(name, "most_iterations_at_first", text, largest(seen.iterations[:3]), 12.0))
    return Findings(rows)


def bad_starts(quick: bool) -> Findings:
    """Meshes that are scrambled, or collapsed to a point or a line, under their weight: they recover in a few steps."""
    scene, init, run = _beam(quick)
    rest = scene.mesh.vertices
    starts = {
        "scrambled": np.random.default_rng(0).uniform(rest.min(axis=0), rest.max(axis=0), rest.shape),
        "point-collapsed": np.broadcast_to(rest.mean(axis=0), rest.shape),
        "line-collapsed": rest * np.array([1.0, 0.0]) + np.array([0.0, 0.5]),
    }
    rows = []
    for name, x in starts.items():
        seen = run(scene.params, init(np.where(scene.free, x, rest)))
        # Elements are inverted at the start, and steps with inverted elements do not count as converged.
        least = _least_J(scene.mesh, seen.x)
        rows += converges(f"start/{name}", seen.converged | (least <= 0), seen.iterations, 100, ALLOWED)
        text = "no element is inverted in the end (a prototype: 0.779)"
        rows.append(expect(f"start/{name}", "least_J", text, least[-1], 0.0, at_least=True))
    return Findings(rows)


def mass_ratio(quick: bool) -> Findings:
    """Vertices that are 1e4 times heavier than their neighbours, in turn."""
    scene, init, run = _beam(quick)
    # More weight would invert elements, which would not be the solver's fault.
    heavy = np.where(np.arange(len(scene.mesh.vertices)) % 2, 1e2, 1e-2)
    stiffer = with_parameters(scene.params, elastic={"youngs_modulus": 1e7})
    seen = run(stiffer._replace(masses=jnp.asarray(heavy)), init())
    text = "a few more than with even masses"
    return Findings(converges("mass-ratio/1e4", seen.converged, seen.iterations, 20, text))


def chain(quick: bool) -> Findings:
    """A chain of 100 springs, released from level, with an end mass 1e4 times that of a link."""
    links, name = 100, "chain/100-springs"
    mesh = Mesh(np.stack([np.linspace(0.0, 10.0, links + 1), np.zeros(links + 1)], axis=1), np.zeros((0, 3), int))
    pairs = np.stack([np.arange(links), np.arange(1, links + 1)], axis=1)
    masses = np.append(np.full(links, 0.01), 100.0)
    terms = [springs(pairs, stiffness=1e7), gravity(mesh, (0.0, -GRAVITY))]
    scene = make_scene(mesh, terms, masses=masses, held=[0])
    init, step = make_step(scene, DT)
    seen = motion(step, 60)(scene.params, init())
    stretch = np.linalg.norm(np.diff(seen.x, axis=1), axis=2).sum(axis=1) / 10.0
    text = "from level, where springs resist no sideways motion"
    rows = converges(name, seen.converged, seen.iterations, 30, text)
    text = "the springs stretch by the load over their stiffness: 3 m g (the fall's pull) over 1e7 N/m, doubled"
    bound = 2 * 3 * 101 * GRAVITY / (1e7 * 0.1)
    return Findings([*rows, expect(name, "largest_stretch", text, largest(abs(stretch - 1)), bound)])


@functools.cache
def _beam(quick: bool):
    """The scene, its `init`, and its motion of `STEPS` steps."""
    scene = cantilever_of(beam(4.0, 1.0, *((16, 4) if quick else (40, 10))))
    init, step = make_step(scene, DT)
    return scene, init, motion(step, STEPS)


def _least_J(mesh: Mesh, x: Any) -> np.ndarray:
    """The smallest det F of all elements, after each step."""
    now = np.stack([simplex_volumes(vertices, mesh.elements) for vertices in x])
    return (now / simplex_volumes(mesh.vertices, mesh.elements)).min(axis=1)
