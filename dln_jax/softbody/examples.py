"""Examples: bodies with loads, ready to be stepped.

| scene | body | motion |
|---|---|---|
| beam | cantilever of 4 m, in the plane or in space | falls under its weight and swings |
| twist | bar of 8 m in space | its ends are twisted against each other, twice or more |
| slope | block in the plane | slides down a plane of slope 0.5, or sticks, by Coulomb friction |
| drop | disc, or box in space | falls on the ground and bounces |
| creature | crawler with muscles | crawls by a wave that runs from its head to its tail |

The last axis points up. Materials are elastic (E in Pa, Poisson's ratio, a density of `strain_energies`); densities are
1000 kg/m³. Elements are linear (`order` 1) or quadratic (2); quadratic ones can be `mixed`, for nu near 1/2. The
creature is the published preset of `terms.creature`.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from dln_jax.softbody.contact.bodies import body_contact
from dln_jax.softbody.mesh.mesh import Mesh, boundary, lumped_masses, vertices_where
from dln_jax.softbody.mesh.shapes import Creature, body_length, box, crawler, disc, quadratic, with_midsides
from dln_jax.softbody.mesh.shapes import beam as beam_mesh
from dln_jax.softbody.scene import SoftScene, make_scene
from dln_jax.softbody.step import Motion
from dln_jax.softbody.terms.contact import plane_contact
from dln_jax.softbody.terms.creature import MASS, TIME_STEP, Bumps, creature_terms
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.loads import gravity
from dln_jax.softbody.terms.strain_energies import StrainEnergy, stable_neo_hookean
from dln_jax.softbody.terms.term import Numbers, Term
from dln_jax.types import InputError

GRAVITY = 9.81
"""In m/s²."""
DENSITY = 1000.0
"""In kg/m³."""
SLOPE = 0.5
"""Rise over run of the slope."""
CONTACT_FRICTION = 0.3
"""Coulomb's coefficient between bodies."""
DROP_SPEED = 2.0
"""Initial velocity of the falling body to the right, in m/s."""
TURNING = 4.0
"""Time in s of turning the bar's ends."""
WAVE_PERIOD = 0.33
"""Period of the creature's muscles, in s."""
WAVE_LENGTH = 2.0
"""Length of the muscle wave, in body lengths."""
WAVE_DELAY = math.pi / 4
"""Phase delay of the back relative to the rest of the skin, in rad."""
SHORTEST, LONGEST = 0.3, 1.0
"""Range of the actuation of the creature's muscles."""


class Example(NamedTuple):
    """A scene with its initial velocities and its drive."""

    scene: SoftScene
    dt: float
    """Suitable time step in s."""
    seconds: float
    """Duration of an illustrative motion in s."""
    v: Any = 0.0
    """Initial velocities in m/s, [n, dim] or one for all; the body starts in its rest shape."""
    ground: float | None = None
    """Slope of the ground (rise over run), which passes through the origin; `None` without ground."""
    control: Callable[[np.ndarray], Any] | None = None
    """Times [T] in s -> actuation [T, k], or a dict of such arrays by actuator."""
    held_path: Callable[[np.ndarray], np.ndarray] | None = None
    """Times [T] in s -> positions of the held vertices [T, k, dim]; by default fixed."""
    muscles: np.ndarray | None = None
    """Pairs of vertices [k, 2], for figures."""
    moments: tuple[float, ...] = (0.0,)
    """Times in s shown in figures."""


def inputs(example: Example, dt: float, steps: int, *, first: int = 0) -> tuple[Any, Motion | None]:
    """Returns the controls and motions of `steps` steps of dt in s from step `first` on, at their ends."""
    t, dtype = dt * np.arange(first + 1, first + steps + 1), example.scene.params.rest.dtype
    control = None if example.control is None else example.control(t)
    motion = None if example.held_path is None else Motion(held=jnp.asarray(example.held_path(t)))
    return jax.tree.map(lambda of: jnp.asarray(of, dtype), (control, motion))


Loads = Callable[[Mesh], Sequence[Term]]


def no_loads(_: Mesh) -> Sequence[Term]:
    """Adds no terms."""
    return ()


def beam(
    *,
    mesh: Mesh | None = None,
    held: ArrayLike | None = None,
    loads: Loads = no_loads,
    dimension: int = 2,
    cells: int = 4,
    youngs_modulus: Numbers = 2e6,
    poisson_ratio: float = 0.3,
    strain_energy: StrainEnergy = stable_neo_hookean,
    order: int = 1,
    mixed: bool = False,
    contact: bool = False,
) -> Example:
    """A beam of 4 m x 1 m (x 1 m) with `cells` cells across, or a custom mesh, held on the left.

    Without `held`, the vertices of smallest x are held. `loads` returns further terms for the mesh.
    """
    if mesh is None:
        _require_dimension(dimension)
        flat = dimension == 2
        mesh = beam_mesh(4.0, 1.0, 4 * cells, cells) if flat else box((4.0, 1.0, 1.0), (4 * cells, cells, cells))
    mesh = _of_order(mesh, order)
    if held is not None and order == 2:
        held = with_midsides(mesh, held)
    if held is None:
        left, extent = mesh.vertices[:, 0].min(), np.ptp(mesh.vertices[:, 0])
        held = vertices_where(mesh, lambda x: x[:, 0] <= left + 1e-9 * extent)
    law = strain_energy, youngs_modulus, poisson_ratio, mixed
    scene = _solid(mesh, *law, contact, gravity(mesh), *loads(mesh), held=held)
    return Example(scene, dt=1 / 60, seconds=6.0, moments=(0.0, 0.4, 0.7, 1.0))


def twist(
    *,
    cells: int = 3,
    turns: float = 2.0,
    youngs_modulus: float = 1e6,
    poisson_ratio: float = 0.4,
    strain_energy: StrainEnergy = stable_neo_hookean,
    order: int = 1,
    mixed: bool = False,
    contact: bool = False,
) -> Example:
    """A bar of 1 m x 8 m x 1 m with ends twisted about its axis in opposite directions, each by half of `turns`.

    Twisting takes 4 s; then the ends are held for 1 s. There is no gravity. Beyond two turns the bar buckles, and
    without `contact` it can pass through itself.
    """
    mesh = _of_order(box((1.0, 8.0, 1.0), (cells, 8 * cells, cells)), order)
    held = vertices_where(mesh, lambda x: (x[:, 1] == 0.0) | (x[:, 1] == 8.0))
    scene = _solid(mesh, strain_energy, youngs_modulus, poisson_ratio, mixed, contact, held=held)
    x, y, z = (mesh.vertices[held] - [0.5, 0.0, 0.5]).T

    def path(t: Float[np.ndarray, " T"]) -> Float[np.ndarray, "T k dim"]:
        angle = 2 * np.pi * turns * np.minimum(t / TURNING, 1.0)[:, None] * np.where(y > 0, 0.5, -0.5)
        across, up = np.cos(angle) * x + np.sin(angle) * z, np.cos(angle) * z - np.sin(angle) * x
        return np.stack([0.5 + across, np.broadcast_to(y, angle.shape), 0.5 + up], axis=-1)

    moments = (0.0, TURNING / 2, TURNING)
    return Example(scene, dt=1 / 60, seconds=TURNING + 1.0, held_path=path, moments=moments)


def slope(
    *,
    cells: int = 4,
    friction: float = 0.3,
    youngs_modulus: float = 1e6,
    poisson_ratio: float = 0.3,
    strain_energy: StrainEnergy = stable_neo_hookean,
    order: int = 1,
    mixed: bool = False,
) -> Example:
    """A block of 1 m x 0.5 m on a plane of slope 0.5 that rises to the right: it slides if friction < 0.5."""
    mesh = _of_order(beam_mesh(1.0, 0.5, 2 * cells, cells), order)
    along = np.array([1.0, SLOPE]) / math.hypot(1.0, SLOPE)
    normal = np.array([-along[1], along[0]])
    mesh = mesh._replace(vertices=mesh.vertices[:, :1] * along + mesh.vertices[:, 1:] * normal)
    ground = _ground(mesh, friction, height=0.5, normal=normal)
    scene = _solid(mesh, strain_energy, youngs_modulus, poisson_ratio, mixed, False, gravity(mesh), ground)
    return Example(scene, dt=1 / 120, seconds=2.0, ground=SLOPE, moments=(0.0, 0.7, 1.2, 1.6, 2.0))


def drop(
    *,
    mesh: Mesh | None = None,
    loads: Loads = no_loads,
    dimension: int = 2,
    cells: int = 5,
    friction: float = 0.5,
    youngs_modulus: Numbers = 3e5,
    poisson_ratio: float = 0.3,
    strain_energy: StrainEnergy = stable_neo_hookean,
    order: int = 1,
    mixed: bool = False,
    contact: bool = False,
    seed: int = 0,
) -> Example:
    """A body that falls from its own height, at 2 m/s to the right and with a random rate of rotation (±1 rad/s).

    The body is a disc of radius 0.5 m with `cells` rings, in space a box of 1 m with a random tilt, or a custom mesh,
    moved to that height. The seed sets rate and tilt. `loads` returns further terms for the mesh.
    """
    random = np.random.default_rng(seed)
    if mesh is None:
        _require_dimension(dimension)
        mesh = disc(0.5, cells) if dimension == 2 else _tilted(box((1.0, 1.0, 1.0), (cells, cells, cells)), random)
    mesh = _of_order(mesh, order)
    height = float(np.ptp(mesh.vertices[:, -1]))
    lift = np.zeros(mesh.dimension)
    lift[-1] = height - mesh.vertices[:, -1].min()
    mesh = mesh._replace(vertices=mesh.vertices + lift)
    ground = _ground(mesh, friction, height=height, normal=np.eye(mesh.dimension)[-1])
    law = strain_energy, youngs_modulus, poisson_ratio, mixed
    scene = _solid(mesh, *law, contact, gravity(mesh), ground, *loads(mesh))
    arms = mesh.vertices - np.average(mesh.vertices, axis=0, weights=np.asarray(scene.params.masses))
    v = np.zeros_like(arms)
    v[:, 0], v[:, -1] = arms[:, -1], -arms[:, 0]
    v *= random.uniform(-1.0, 1.0)
    v[:, 0] += DROP_SPEED
    return Example(scene, dt=1 / 200, seconds=2.5, v=v, ground=0.0, moments=(0.0, 0.3, 0.52, 0.9, 1.25))


def creature_scene(creature: Creature, bumps: Bumps | None = None) -> SoftScene:
    """Returns the scene of a preset creature above flat ground, or rough ground with `bumps`."""
    return make_scene(creature.mesh, creature_terms(creature.mesh, creature.muscles, bumps=bumps), masses=MASS)


def creature() -> Example:
    """The crawler: a wave of shortening muscles from head to tail pushes it forwards."""
    body = crawler()
    scene = creature_scene(body)
    x, y = body.mesh.vertices[body.muscles].mean(axis=1).T
    phase = 2 * np.pi * x / (WAVE_LENGTH * body_length(body)) - WAVE_DELAY * (y > 0.75 * body.mesh.vertices[:, 1].max())
    mean, amplitude = (LONGEST + SHORTEST) / 2, (LONGEST - SHORTEST) / 2

    def control(t: Float[np.ndarray, " T"]) -> Float[np.ndarray, "T k"]:
        return mean + amplitude * np.sin(2 * np.pi * t[:, None] / WAVE_PERIOD + phase)

    moments = (0.0, 3.0, 6.0)
    return Example(scene, TIME_STEP, 6.0, ground=0.0, control=control, muscles=body.muscles, moments=moments)


EXAMPLES: dict[str, Callable[..., Example]] = {scene.__name__: scene for scene in (beam, twist, slope, drop, creature)}
"""Examples by name; their keyword arguments are their options."""


def _solid(
    mesh: Mesh,
    strain_energy: StrainEnergy,
    youngs_modulus: Numbers,
    poisson_ratio: float,
    mixed: bool,
    contact: bool,
    *others: Term,
    held: ArrayLike = (),
) -> SoftScene:
    """Builds the scene, with `contact` of all surfaces within a tenth of the boundary's shortest edge."""
    material = elastic(mesh, strain_energy, youngs_modulus=youngs_modulus, poisson_ratio=poisson_ratio, mixed=mixed)
    contacts = []
    if contact:
        corners = mesh.vertices[boundary(mesh)]
        distance = 0.1 * float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).min())
        stiffness = 0.1 * float(np.min(youngs_modulus))
        contacts = [body_contact(mesh, distance=distance, stiffness=stiffness, friction=CONTACT_FRICTION)]
    return make_scene(mesh, [material, *others], density=DENSITY, held=held, contacts=contacts)


def _ground(mesh: Mesh, friction: float, *, height: float, normal: np.ndarray) -> Term:
    """A stiff plane: one vertex with the whole weight sinks by a thousandth of the body's height."""
    stiffness = 1e3 * (GRAVITY * float(lumped_masses(mesh, DENSITY).sum())) / height
    every = np.arange(len(mesh.vertices))
    return plane_contact(every, normal=normal, stiffness=stiffness, width=1e-3 * height, friction=friction)


def _tilted(mesh: Mesh, random: np.random.Generator) -> Mesh:
    """Rotates a mesh at random by at most about half a radian."""
    axis = 0.25 * random.normal(size=3)
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    # Cayley's transform of a skew matrix is a rotation.
    rotation = np.linalg.solve(np.eye(3) - skew / 2, np.eye(3) + skew / 2)
    return mesh._replace(vertices=mesh.vertices @ rotation.T)


def _of_order(mesh: Mesh, order: int) -> Mesh:
    if order not in (1, 2):
        raise InputError(f"order is {order}; expected 1 (linear elements) or 2 (quadratic elements)")
    return mesh if order == 1 or mesh.midsides is not None else quadratic(mesh)


def _require_dimension(dimension: int) -> None:
    if dimension not in (2, 3):
        raise InputError(f"dimension is {dimension}; expected 2 or 3")
