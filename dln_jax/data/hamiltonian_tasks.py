"""The published data of four Hamiltonian tasks (Greydanus, Dzamba and Yosinski 2019, "Hamiltonian Neural Networks").

| task | H | trajectories x samples | t | starts | noise | test |
|---|---|---|---|---|---|---|
| `spring` | q² + p² | 50 x 30 | 0..3 | radius 0.1..1 of (q, p) | sd 0.1 on q and p | the second half |
| `pendulum` | 3 (1 - cos q) + p² | 50 x 45 | 0..3 | radius 1.3..2.3 of (q, p) | sd 0.1 on q and p | the second half |
| `two_body` | ½ p² - 1/r | 1000 x 50 | 0..20 | ±x, x in [0.5, 1.5]² | none | the first fifth |
| `three_body` | ½ p² - sum 1/r_ij | 5000 x 20 | 0..5 | equilateral, 0.9..1.2 from the centre | none | the first fifth |

Directions of (q, p), and of the triangle, are those of a point drawn in a square, so that diagonals are likelier. Two
bodies start on a circular orbit with speeds times 1 + 0.05 normal; three with each component of each velocity times
1 + 0.2 uniform(-1, 1), so that their centre drifts. All times are evenly spaced, both ends included.

The convention of derivatives: `qd` and `pd` are the exact field at the NOISELESS point, while q and p beside them are
noisy. The true field therefore misses them by the noise: with seed 0 its test loss is 3.82e-2 on the spring and
3.56e-2 on the pendulum. What tells models apart is `field`, the exact field at the noisy point. Units are those of the
table, with masses and G of one.

The draws are made in the published order from the generator that numpy keeps frozen, so that a seed gives the
published starts and noise. The published motions were integrated to about 1e-6; here energies are constant to 1e-9.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dln_jax.data.generators import in_float64
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import select
from dln_jax.mechanics import hamiltonian
from dln_jax.mechanics.integrators import adaptive_rollout
from dln_jax.scenes.mass_spring import mass_spring
from dln_jax.scenes.n_body import n_body
from dln_jax.scenes.pendulum import pendulum as pendulum_scene
from dln_jax.scenes.scene import Scene
from dln_jax.types import Dissipation, Hamiltonian, InputError, Scalar, Vector, require_positive


class Field(NamedTuple):
    """Time derivatives of states."""

    qd: np.ndarray
    """[N, d]."""
    pd: np.ndarray
    """[N, d]."""


class Part(NamedTuple):
    """One side of the published split; all members have the same N samples."""

    data: Trajectories
    """As published: q and p with noise; qd, pd (and qdd) of the noiseless motion; tau = 0, which is exact."""
    clean: Trajectories
    """The same samples without noise."""
    field: Field
    """The exact (qd, pd) at the noisy q, p of `data`."""


class Task(NamedTuple):
    """A published data set, and what it was made from."""

    scene: Scene
    hamiltonian: Hamiltonian
    """(q, p) -> H of one state: the textbook's."""
    published_energy: Hamiltonian
    """(q, p) -> the quantity whose error was published as that of the energy: q² + p² for the pendulum, else H."""
    t: np.ndarray
    """Times of each trajectory [T], in s."""
    train: Part
    test: Part


@in_float64
def spring(
    seed: int = 0, *, trajectories: int = 50, friction: float = 0.0, noise: float = 0.1, tolerance: float = 1e-12
) -> Task:
    """The mass on a spring, H = q² + p²: mass ½, stiffness 2; with `friction` (force by velocity) damped."""
    scene = mass_spring(mass=0.5, stiffness=2.0, friction=friction)
    return _oscillator(scene, _circle, _circle, 30, (0.1, 1.0), seed, trajectories, noise, tolerance)


@in_float64
def pendulum(
    seed: int = 0, *, trajectories: int = 50, friction: float = 0.0, noise: float = 0.1, tolerance: float = 1e-12
) -> Task:
    """The pendulum, H = 3 (1 - cos q) + p²: mass ½, length 1, acceleration 6; with `friction` damped."""
    scene = pendulum_scene(mass=0.5, length=1.0, acceleration=6.0, friction=friction)
    return _oscillator(scene, _swing, _circle, 45, (1.3, 2.3), seed, trajectories, noise, tolerance)


@in_float64
def two_body(seed: int = 0, *, trajectories: int = 1000, tolerance: float = 1e-12) -> Task:
    """Two bodies on orbits that are almost circular; q = (x1, y1, x2, y2), and p is the velocity."""
    random = np.random.RandomState(seed)
    starts = []
    for _ in range(trajectories):
        x = 0.5 + random.rand(2)
        velocity = _turned(x, np.pi / 2) / (2 * np.hypot(*x) ** 1.5) * (1 + 0.05 * random.randn())
        starts.append(([*x, *-x], [*velocity, *-velocity]))
    return _bodies(2, np.array(starts), np.linspace(0, 20, 50), tolerance)


@in_float64
def three_body(seed: int = 0, *, trajectories: int = 5000, tolerance: float = 1e-12) -> Task:
    """Three bodies that leave a rotating triangle; q = (x1, y1, x2, y2, x3, y3), and p is the velocity."""
    random = np.random.RandomState(seed)
    third = 2 * np.pi / 3
    starts = []
    for _ in range(trajectories):
        direction = 2 * random.rand(2) - 1
        radius = 0.9 + 0.3 * random.rand()
        x = direction * radius / np.hypot(*direction)
        # Each is pulled inward by 1 / (sqrt(3) radius²), which a circle takes at this velocity.
        velocity = _turned(x, np.pi / 2) / (radius**1.5 * 3**0.25)
        change = 1 + 0.2 * (2 * random.rand(3, 2) - 1)
        q, p = (np.array([_turned(vector, k * third) for k in range(3)]) for vector in (x, velocity))
        starts.append((q.ravel(), (change * p).ravel()))
    return _bodies(3, np.array(starts), np.linspace(0, 5, 20), tolerance)


_GROUP = 500


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
    """Free motions (q, p) at the times t from the states at t[0], integrated adaptively to the tolerance per step.

    Between steps states are interpolated, with an error of a few hundred times the tolerance.

    Raises:
        InputError: an integration does not finish, as where bodies meet.
    """
    require_positive(tolerance=tolerance)
    # Motions of one call take as many steps as the slowest of them: in groups, fewer wait. The last group is filled up.
    size = min(len(q), _GROUP)
    groups = [np.minimum(np.arange(first, first + size), len(q) - 1) for first in range(0, len(q), size)]
    solved = [_solve(H, dissipation, tolerance, q[group], p[group], t) for group in groups]
    if not all(bool(successful.all()) for _, successful in solved):
        raise InputError(f"a motion could not be integrated to {tolerance:g}; ask for less accuracy or time")
    motions = (np.concatenate([states[half] for states, _ in solved])[: len(q)] for half in range(2))
    return next(motions), next(motions)


# Compiled once for each Hamiltonian, so that further seeds start at once.
@functools.partial(jax.jit, static_argnames=("H", "dissipation", "tolerance"))
def _solve(H: Hamiltonian, dissipation: Dissipation | None, tolerance: float, q, p, t):
    def motion(q, p):
        def rate(t, state):
            return _field(H, dissipation, *state)

        return adaptive_rollout(rate, (q, p), t, tolerance=tolerance)

    return jax.vmap(motion)(q, p)


@functools.partial(jax.jit, static_argnames=("H", "dissipation"))
def _fields(H: Hamiltonian, dissipation: Dissipation | None, q, p):
    return jax.vmap(functools.partial(_field, H, dissipation))(q, p)


def _field(H: Hamiltonian, dissipation: Dissipation | None, q: Vector, p: Vector) -> tuple[Vector, Vector]:
    return hamiltonian.time_derivative(H, q, p, jnp.zeros_like(q), dissipation=dissipation)


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
    published_energy: Hamiltonian,
    samples: int,
    radii: tuple[float, float],
    seed: int,
    trajectories: int,
    noise: float,
    tolerance: float,
) -> Task:
    if not noise >= 0:
        raise InputError(f"noise is {noise}; expected a standard deviation, zero for none")
    random = np.random.RandomState(seed)
    starts, errors = [], []
    for _ in range(trajectories):
        direction = 2 * random.rand(2) - 1
        radius = radii[0] + (radii[1] - radii[0]) * random.rand()
        starts.append(direction * radius / np.hypot(*direction))
        errors.append(noise * random.randn(2, samples))
    half = trajectories // 2
    t = np.linspace(0, 3, samples)
    starts, errors = np.array(starts).reshape(-1, 2, 1), np.array(errors).reshape(-1, 2, samples, 1)
    return _task(scene, H, published_energy, starts, errors, t, slice(0, half), tolerance)


@functools.cache
def _attracting(n: int) -> tuple[Scene, Hamiltonian]:
    scene = n_body(n)

    def H(q: Vector, p: Vector) -> Scalar:
        assert scene.potential is not None
        return 0.5 * jnp.sum(p**2) + scene.potential(q)

    return scene, H


def _bodies(n: int, starts: np.ndarray, t: np.ndarray, tolerance: float) -> Task:
    scene, H = _attracting(n)
    return _task(scene, H, H, starts, None, t, slice(len(starts) // 5, None), tolerance)


def _task(
    scene: Scene,
    H: Hamiltonian,
    published_energy: Hamiltonian,
    starts: np.ndarray,
    errors: np.ndarray | None,
    t: np.ndarray,
    trained: slice,
    tolerance: float,
) -> Task:
    """From starts (q, p) [K, 2, d] and the noise of both [K, 2, T, d]."""
    order = np.arange(len(starts))
    train, test = order[trained], np.setdiff1d(order, order[trained])
    if not len(train) or not len(test):
        raise InputError(f"trajectories is {len(starts)}; expected enough to leave some on both sides of the split")
    d = scene.needs.degrees_of_freedom
    motion = reference_motion(H, starts[:, 0], starts[:, 1], t, dissipation=scene.dissipation, tolerance=tolerance)
    exact = functools.partial(_fields, H, scene.dissipation)
    q, p = (states.reshape(-1, d) for states in motion)
    qd, pd = (np.asarray(rate) for rate in exact(q, p))
    clean = Trajectories(
        t=np.tile(t, len(starts)),
        q=q,
        qd=qd,
        # The masses of these scenes are constant and act on one coordinate each.
        qdd=pd / np.diag(scene.mass_matrix(jnp.asarray(q[0]))),
        tau=np.zeros_like(q),
        trajectory=np.repeat(order, len(t)),
        label=np.array([f"{scene.name}-{index}" for index in order]),
        p=p,
        pd=pd,
        needs=scene.needs,
    )
    if errors is None:
        data, field = clean, Field(qd, pd)
    else:
        data = clean._replace(q=q + errors[:, 0].reshape(-1, d), p=p + errors[:, 1].reshape(-1, d))
        field = Field(*(np.asarray(rate) for rate in exact(data.q, data.p)))

    def part(indices: np.ndarray) -> Part:
        chosen = np.isin(clean.trajectory, indices)
        return Part(select(data, indices), select(clean, indices), Field(field.qd[chosen], field.pd[chosen]))

    return Task(scene, H, published_energy, t, part(train), part(test))


Protocol = Callable[..., Task]
"""(seed, *, trajectories, tolerance, ...) -> data."""
PROTOCOLS: dict[str, Protocol] = {
    "spring": spring,
    "pendulum": pendulum,
    "two-body": two_body,
    "three-body": three_body,
}
"""By the names that command lines use."""
