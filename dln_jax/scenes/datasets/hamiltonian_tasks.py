"""Datasets of Hamiltonian tasks: four published tasks, damped oscillators, and two systems with two coordinates.

Published (Greydanus, Dzamba and Yosinski 2019, "Hamiltonian Neural Networks"):

| task | H | trajectories x samples | t | starts | noise | test |
|---|---|---|---|---|---|---|
| `spring` | q² + p² | 50 x 30 | 0..3 | radius 0.1..1 of (q, p) | sd 0.1 on q and p | the second half |
| `pendulum` | 3 (1 - cos q) + p² | 50 x 45 | 0..3 | radius 1.3..2.3 of (q, p) | sd 0.1 on q and p | the second half |
| `two_body` | ½ p² - 1/r | 1000 x 50 | 0..20 | ±x, x in [0.5, 1.5]² | none | the first fifth |
| `three_body` | ½ p² - sum 1/r_ij | 5000 x 20 | 0..5 | equilateral, 0.9..1.2 from the centre | none | the first fifth |

Directions of (q, p) and of the triangle point to a random point in a square, so diagonals are more likely. The two
bodies start on a circular orbit with speeds multiplied by 1 + 0.05 normal. For the three bodies every velocity
component is multiplied by 1 + 0.2 uniform(-1, 1), so their centre of mass drifts. Times are evenly spaced, ends
included.

Convention for the derivatives: `qd` and `pd` are the exact field at the NOISELESS point, while q and p are noisy.
Because of the noise, the true field has a test loss: 3.82e-2 on the spring and 3.56e-2 on the pendulum with seed 0. To
compare models, use `field`, the exact field at the noisy point. Units are as in the table, with unit masses and G.

Added by this project, with the same conventions: `damped-spring` and `damped-pendulum` (the first two tasks with a
viscous friction of 0.1), and, without noise, 100 trajectories x 50 samples each, the first fifth for the test:

| task | starts | t |
|---|---|---|
| `henon_heiles` | within 0.25 of the centre, with an energy of 0.05..0.125 (it escapes from 1/6 on) | 0..10 |
| `double_pendulum` | at rest, each angle within 1.2 rad of hanging | 0..2.5 |

Random numbers are drawn in the published order from NumPy's frozen generator, so a seed gives the published starts and
noise. The published motions were integrated to about 1e-6; here energies are constant to 1e-9.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import select
from dln_jax.mechanics import hamiltonian
from dln_jax.mechanics.integrators import adaptive_rollout
from dln_jax.precision import in_float64
from dln_jax.scenes.particles import henon_heiles as henon_heiles_scene
from dln_jax.scenes.particles import mass_spring, n_body
from dln_jax.scenes.pendulums import double_pendulum as double_pendulum_scene
from dln_jax.scenes.pendulums import pendulum as pendulum_scene
from dln_jax.scenes.scene import Scene
from dln_jax.types import Dissipation, Hamiltonian, InputError, Potential, Scalar, Vector, require_positive

_GROUP = 500


class PhaseSamples(NamedTuple):
    """One side of the published split: the same N samples with and without noise."""

    data: Trajectories
    """As published: q and p with noise; qd, pd (and qdd) without noise; tau = 0 exactly."""
    clean: Trajectories
    """The same samples without noise."""
    field: Trajectories
    """`data` with the exact (qd, pd) at its noisy q, p."""


class PhaseTask(NamedTuple):
    """A published dataset and the system that generated it."""

    scene: Scene
    hamiltonian: Hamiltonian
    """(q, p) -> the textbook H of one state."""
    published_energy: Hamiltonian
    """(q, p) -> the quantity published as the energy: q² + p² for the pendulum, else H."""
    t: np.ndarray
    """Times of every trajectory [T], s."""
    train: PhaseSamples
    test: PhaseSamples


@in_float64
def spring(seed: int = 0, *, trajectories: int = 50, friction: float = 0.0, noise: float = 0.1) -> PhaseTask:
    """Mass on a spring, H = q² + p²: mass ½, stiffness 2; damped by `friction` (force over velocity)."""
    scene = mass_spring(mass=0.5, stiffness=2.0, friction=friction)
    return _oscillator(scene, _circle, 30, (0.1, 1.0), seed, trajectories, noise)


@in_float64
def pendulum(seed: int = 0, *, trajectories: int = 50, friction: float = 0.0, noise: float = 0.1) -> PhaseTask:
    """Pendulum, H = 3 (1 - cos q) + p²: mass ½, length 1, acceleration 6; damped by `friction`."""
    scene = pendulum_scene(mass=0.5, length=1.0, acceleration=6.0, friction=friction)
    return _oscillator(scene, _swing, 45, (1.3, 2.3), seed, trajectories, noise)


@in_float64
def two_body(seed: int = 0, *, trajectories: int = 1000) -> PhaseTask:
    """Two bodies on nearly circular orbits; q = (x1, y1, x2, y2), and p is the velocity."""
    random = np.random.RandomState(seed)
    starts = []
    for _ in range(trajectories):
        x = 0.5 + random.rand(2)
        velocity = _turned(x, np.pi / 2) / (2 * np.hypot(*x) ** 1.5) * (1 + 0.05 * random.randn())
        starts.append(([*x, *-x], [*velocity, *-velocity]))
    return _task(*_attracting(2), np.array(starts), np.linspace(0, 20, 50))


@in_float64
def three_body(seed: int = 0, *, trajectories: int = 5000) -> PhaseTask:
    """Three bodies that start from a rotating triangle; q = (x1, y1, x2, y2, x3, y3), and p is the velocity."""
    random = np.random.RandomState(seed)
    third = 2 * np.pi / 3
    starts = []
    for _ in range(trajectories):
        direction = 2 * random.rand(2) - 1
        radius = 0.9 + 0.3 * random.rand()
        x = direction * radius / np.hypot(*direction)
        # At this velocity the inward pull 1 / (sqrt(3) radius²) keeps a body on a circle.
        velocity = _turned(x, np.pi / 2) / (radius**1.5 * 3**0.25)
        change = 1 + 0.2 * (2 * random.rand(3, 2) - 1)
        q, p = (np.array([_turned(vector, k * third) for k in range(3)]) for vector in (x, velocity))
        starts.append((q.ravel(), (change * p).ravel()))
    return _task(*_attracting(3), np.array(starts), np.linspace(0, 5, 20))


@in_float64
def henon_heiles(seed: int = 0, *, trajectories: int = 100) -> PhaseTask:
    """A unit mass in the Hénon-Heiles potential, on orbits that stay in the well."""
    scene, H = _system(henon_heiles_scene)
    random = np.random.default_rng(seed)
    angle, direction = random.uniform(0, 2 * np.pi, (2, trajectories))
    radius = 0.25 * np.sqrt(random.uniform(size=trajectories))
    q = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    kinetic = random.uniform(0.05, 0.125, trajectories) - np.asarray(jax.vmap(_potential(scene))(jnp.asarray(q)))
    p = np.sqrt(2 * kinetic)[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=1)
    return _task(scene, H, np.stack([q, p], axis=1), np.linspace(0, 10, 50))


@in_float64
def double_pendulum(seed: int = 0, *, trajectories: int = 100) -> PhaseTask:
    """The double pendulum of 1 kg and 1 m, released from rest."""
    q = np.random.default_rng(seed).uniform(-1.2, 1.2, (trajectories, 2))
    starts = np.stack([q, np.zeros_like(q)], axis=1)
    return _task(*_system(double_pendulum_scene), starts, np.linspace(0, 2.5, 50))


# One cached object per system, so that jit finds functions already compiled.
@functools.cache
def _system(make: Callable[[], Scene]) -> tuple[Scene, Hamiltonian]:
    scene = make()
    # One Newton step is exact for a quadratic kinetic energy.
    return scene, hamiltonian.legendre(scene.lagrangian, iterations=1)


@functools.cache
def _attracting(n: int) -> tuple[Scene, Hamiltonian]:
    scene = n_body(n)
    potential = _potential(scene)
    return scene, lambda q, p: 0.5 * jnp.sum(p**2) + potential(q)


def _potential(scene: Scene) -> Potential:
    if scene.potential is None:
        raise InputError(f"{scene.name} has no potential; expected a scene with one")
    return scene.potential


def _circle(q: Vector, p: Vector) -> Scalar:
    return jnp.sum(q**2 + p**2)


def _swing(q: Vector, p: Vector) -> Scalar:
    return jnp.sum(3 * (1 - jnp.cos(q)) + p**2)


def _turned(vector: np.ndarray, angle: float) -> np.ndarray:
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([cosine * vector[0] - sine * vector[1], sine * vector[0] + cosine * vector[1]])


def _oscillator(
    scene: Scene,
    H: Hamiltonian,
    samples: int,
    radii: tuple[float, float],
    seed: int,
    trajectories: int,
    noise: float,
) -> PhaseTask:
    if not noise >= 0:
        raise InputError(f"noise is {noise}; expected a standard deviation of at least 0")
    random = np.random.RandomState(seed)
    starts, errors = [], []
    for _ in range(trajectories):
        direction = 2 * random.rand(2) - 1
        radius = radii[0] + (radii[1] - radii[0]) * random.rand()
        starts.append(direction * radius / np.hypot(*direction))
        errors.append(noise * random.randn(2, samples))
    starts, errors = np.array(starts).reshape(-1, 2, 1), np.array(errors).reshape(-1, 2, samples, 1)
    task = _task(scene, H, starts, np.linspace(0, 3, samples), errors, slice(0, trajectories // 2))
    return task._replace(published_energy=_circle)


def _task(
    scene: Scene,
    H: Hamiltonian,
    starts: Float[np.ndarray, "K two d"],
    t: Float[np.ndarray, " T"],
    errors: Float[np.ndarray, "K two T d"] | None = None,
    training: slice | None = None,
) -> PhaseTask:
    """Returns a task from starts (q, p) at the times t, with errors added to both; by default the first fifth is the
    test.

    Raises:
        InputError: one side of the split has no trajectories.
    """
    order = np.arange(len(starts))
    train = order[training or slice(len(order) // 5, None)]
    test = np.setdiff1d(order, train)
    if not len(train) or not len(test):
        raise InputError(f"trajectories is {len(starts)}; expected enough for both sides of the split")
    d = scene.needs.degrees_of_freedom
    motion = reference_motion(H, starts[:, 0], starts[:, 1], t, dissipation=scene.dissipation)
    exact = functools.partial(_fields, H, scene.dissipation)
    q, p = (states.reshape(-1, d) for states in motion)
    qd, pd = (np.asarray(rate) for rate in exact(q, p))
    qdd = np.asarray(_accelerations(H, q, p, qd, pd))
    trajectory, label = np.repeat(order, len(t)), np.array([f"{scene.name}-{index}" for index in order])
    times, tau = np.tile(t, len(starts)), np.zeros_like(q)
    data = clean = field = Trajectories(times, q, qd, qdd, tau, trajectory, label, p, pd, needs=scene.needs)
    if errors is not None:
        data = clean._replace(q=q + errors[:, 0].reshape(-1, d), p=p + errors[:, 1].reshape(-1, d))
        noisy_qd, noisy_pd = (np.asarray(rate) for rate in exact(data.q, data.p))
        field = data._replace(qd=noisy_qd, pd=noisy_pd)

    def part(indices: np.ndarray) -> PhaseSamples:
        return PhaseSamples(*(select(motions, indices) for motions in (data, clean, field)))

    return PhaseTask(scene, H, H, t, part(train), part(test))


@in_float64
def reference_motion(
    H: Hamiltonian,
    q: Float[np.ndarray, "K d"],
    p: Float[np.ndarray, "K d"],
    t: Float[np.ndarray, " T"],
    *,
    dissipation: Dissipation | None = None,
    tolerance: float = 1e-12,
) -> tuple[Float[np.ndarray, "K T d"], Float[np.ndarray, "K T d"]]:
    """Returns free motions (q, p) at times t from states at t[0], integrated adaptively to a tolerance per step.

    States between steps are interpolated, with an error of a few hundred times the tolerance.

    Raises:
        InputError: an integration does not finish, for example because bodies meet.
    """
    require_positive(tolerance=tolerance)
    # All motions of a call take as many steps as the slowest one, so smaller groups save time. The last group is
    # padded.
    size = min(len(q), _GROUP)
    groups = [np.minimum(np.arange(first, first + size), len(q) - 1) for first in range(0, len(q), size)]
    solved = [_solve(H, dissipation, tolerance, q[group], p[group], t) for group in groups]
    if not all(successful.all() for _, successful in solved):
        raise InputError(
            f"the integration failed at tolerance {tolerance:g}; raise the tolerance or shorten the motion"
        )
    q, p = (np.concatenate([states[half] for states, _ in solved])[: len(q)] for half in range(2))
    return q, p


# Compiled once per Hamiltonian, so further seeds start at once.
@functools.partial(jax.jit, static_argnames=("H", "dissipation", "tolerance"))
def _solve(H: Hamiltonian, dissipation: Dissipation | None, tolerance: float, q, p, t):
    def rate(t, state):
        return _field(H, dissipation, *state)

    return jax.vmap(lambda q, p: adaptive_rollout(rate, (q, p), t, tolerance=tolerance))(q, p)


@functools.partial(jax.jit, static_argnames=("H", "dissipation"))
def _fields(H: Hamiltonian, dissipation: Dissipation | None, q, p):
    return jax.vmap(functools.partial(_field, H, dissipation))(q, p)


def _field(H: Hamiltonian, dissipation: Dissipation | None, q: Vector, p: Vector) -> tuple[Vector, Vector]:
    return hamiltonian.time_derivative(H, q, p, jnp.zeros_like(q), dissipation=dissipation)


@functools.partial(jax.jit, static_argnames=("H",))
def _accelerations(H: Hamiltonian, q, p, qd, pd):
    """Returns qdd = d/dt dH/dp along the motion."""
    return jax.vmap(lambda *state: jax.jvp(jax.grad(H, argnums=1), state[:2], state[2:])[1])(q, p, qd, pd)


PROTOCOLS: dict[str, Callable[..., PhaseTask]] = {
    "spring": spring,
    "pendulum": pendulum,
    "damped-spring": functools.partial(spring, friction=0.1),
    "damped-pendulum": functools.partial(pendulum, friction=0.1),
    "henon-heiles": henon_heiles,
    "double-pendulum": double_pendulum,
    "two-body": two_body,
    "three-body": three_body,
}
"""(seed, *, trajectories, ...) -> data, by the names of tasks on the command line."""
