"""The scenes of the Hamiltonian tasks against closed forms; the published protocols: counts, starts, noise, seeds."""

import functools
import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from conftest import slow_among

from dln_jax.mechanics.equations import dynamics
from dln_jax.scenes.datasets import hamiltonian_tasks
from dln_jax.scenes.datasets.hamiltonian_tasks import PROTOCOLS, reference_motion
from dln_jax.scenes.particles import henon_heiles, mass_spring, n_body

SCENES = [
    mass_spring(mass=0.7, stiffness=3.0, friction=0.2),
    henon_heiles(coupling=0.8, friction=0.1),
    n_body(3, masses=(1.0, 2.0, 0.5), dimension=3, G=1.3, softening=0.2),
]


def named(*names):
    """Tasks; motions of the pendulum and of three bodies take seconds to compile."""
    return slow_among(names, lambda name: name in ("pendulum", "three-body"))


@functools.cache
def task(name):
    """As published, with fewer orbits of the bodies."""
    return PROTOCOLS[name](3) if name in ("spring", "pendulum") else PROTOCOLS[name](3, trajectories=20)


@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.name)
def test_scenes_in_closed_form_equal_the_generic_mechanics(scene):
    q, qd, third = np.random.default_rng(0).normal(size=(3, scene.needs.degrees_of_freedom))

    @jax.jit
    def ask():
        system, known = dynamics(scene.energies), dynamics(scene.closed_form)
        return (
            (jax.grad(scene.potential)(q), scene.gravity(q)),
            (system.inverse_dynamics(q, qd, third), known.inverse_dynamics(q, qd, third)),
        )

    for got, expected in ask():
        np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-13)


def test_henon_heiles_has_its_saddles_at_a_sixth():
    angles = np.pi / 6 * np.array([3, 7, 11])
    saddles = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    energy, slope = jax.vmap(jax.value_and_grad(henon_heiles().potential))(saddles)
    np.testing.assert_allclose(energy, 1 / 6, rtol=1e-14)
    np.testing.assert_allclose(slope, 0, atol=1e-14)


def test_absent_terms_are_absent_and_softening_is_a_length():
    for free in (mass_spring(stiffness=0.0), n_body(2, G=0.0)):
        assert free.potential is None and free.gravity is None and not free.needs.gravity
    assert n_body(3).potential(np.zeros(6)) == -np.inf
    assert n_body(2, dimension=1, softening=3.0).potential(np.array([0.0, 4.0])) == pytest.approx(-1 / 5)


@pytest.mark.parametrize("name", named("spring", "pendulum"))
def test_energies_are_the_published_ones(name):
    dataset = task(name)
    q, p = np.random.default_rng(0).normal(size=(2, 20, 1))
    circle = (q**2 + p**2)[:, 0]
    true = circle if name == "spring" else (3 * (1 - np.cos(q)) + p**2)[:, 0]
    np.testing.assert_allclose(jax.vmap(dataset.hamiltonian)(q, p), true, rtol=1e-13)
    np.testing.assert_allclose(jax.vmap(dataset.published_energy)(q, p), circle, rtol=1e-13)


COUNTS = {
    "spring": (50, 30, 3.0, 25),
    "pendulum": (50, 45, 3.0, 25),
    "two-body": (1000, 50, 20.0, 16),
    "three-body": (5000, 20, 5.0, 16),
}
"""Published trajectories, samples of each, last time; trajectories that `task` trains on."""


@pytest.mark.parametrize("name", named(*COUNTS))
def test_counts_times_splits_and_constant_energies(name):
    published, samples, end, trained = COUNTS[name]
    dataset = task(name)
    assert inspect.signature(PROTOCOLS[name]).parameters["trajectories"].default == published
    np.testing.assert_allclose(dataset.t, end * np.arange(samples) / (samples - 1), rtol=1e-14)
    train, test = (np.unique(part.data.trajectory) for part in (dataset.train, dataset.test))
    # The oscillators are tested on the last trajectories, the bodies on the first.
    first, last = (train, test) if name in ("spring", "pendulum") else (test, train)
    assert len(train) == trained
    np.testing.assert_array_equal(np.concatenate([first, last]), np.arange(len(train) + len(test)))
    for part in (dataset.train, dataset.test):
        count = len(np.unique(part.data.trajectory))
        np.testing.assert_array_equal(part.data.t.reshape(-1, samples), np.tile(dataset.t, (count, 1)))
        assert not part.data.tau.any() and part.data.needs == dataset.scene.needs
        energy = np.asarray(jax.vmap(dataset.hamiltonian)(part.clean.q, part.clean.p)).reshape(count, samples)
        assert np.abs(energy - energy[:, :1]).max() < 1e-9
        assert (np.ptp(part.clean.q.reshape(count, samples, -1), axis=1) > 0.05).all(), "motions that stand still"


@pytest.mark.parametrize("name", named(*COUNTS))
def test_derivatives_are_exact_at_the_noiseless_points(name):
    """By the scene's closed forms; `field` is the same at the noisy ones."""
    dataset = task(name)
    mass = np.diag(dataset.scene.mass_matrix(jnp.zeros(dataset.scene.needs.degrees_of_freedom)))
    gravity = jax.jit(jax.vmap(dataset.scene.gravity))
    data, clean, field = dataset.train
    np.testing.assert_allclose(data.qd, clean.p / mass, rtol=1e-12)
    np.testing.assert_allclose(data.pd, -gravity(clean.q), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(data.qdd, data.pd / mass, rtol=1e-12)
    np.testing.assert_allclose(field.qd, data.p / mass, rtol=1e-12)
    np.testing.assert_allclose(field.pd, -gravity(data.q), rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(clean.pd, data.pd)


@pytest.mark.parametrize("name", named("spring", "pendulum"))
def test_radii_and_noise_of_the_oscillators(name):
    inner, outer = (0.1, 1.0) if name == "spring" else (1.3, 2.3)
    parts = (task(name).train, task(name).test)
    radii = np.concatenate([np.hypot(clean.q, clean.p)[clean.t == 0] for _, clean, _ in parts])
    errors = np.concatenate([np.hstack([data.q - clean.q, data.p - clean.p]) for data, clean, _ in parts])
    assert (radii > inner).all() and (radii < outer).all() and np.ptp(radii) > 0.8 * (outer - inner)
    count = len(errors)
    np.testing.assert_allclose(errors.mean(axis=0), 0, atol=0.5 / np.sqrt(count))
    # Independent of each other and of the sample before.
    np.testing.assert_allclose(errors.T @ errors / count, 0.01 * np.eye(2), atol=0.05 / np.sqrt(count))
    assert abs(np.mean(errors[1:] * errors[:-1])) < 0.05 / np.sqrt(2 * count)


@pytest.mark.slow
def test_the_damped_spring_follows_its_closed_form():
    """½ q'' + b q' + 2 q = 0: q = exp(-b t) (q0 cos wt + (q0' + b q0)/w sin wt), w² = 4 - b²."""
    b = 0.3
    damped = hamiltonian_tasks.spring(1, trajectories=2, friction=b, noise=0.0)
    q, qd, t = (getattr(damped.train.data, key).ravel() for key in ("q", "qd", "t"))
    w = np.sqrt(4 - b**2)
    expected = np.exp(-b * t) * (q[0] * np.cos(w * t) + (qd[0] + b * q[0]) / w * np.sin(w * t))
    np.testing.assert_allclose(q, expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(damped.train.data.pd[:, 0], -2 * q - b * qd, rtol=1e-10, atol=1e-12)
    np.testing.assert_array_equal(damped.train.data.q, damped.train.clean.q)
    assert damped.scene.needs.friction


def starts(name):
    """Positions and velocities at t = 0, [K, bodies, 2]."""
    dataset = task(name)
    parts = [part.clean for part in (dataset.test, dataset.train)]
    bodies = dataset.scene.needs.degrees_of_freedom // 2
    return (
        np.concatenate([getattr(part, key)[part.t == 0] for part in parts]).reshape(-1, bodies, 2) for key in ("q", "p")
    )


def crossed(a, b):
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def test_two_bodies_start_almost_on_circles():
    (x, other), (v, opposite) = (each.swapaxes(0, 1) for each in starts("two-body"))
    np.testing.assert_array_equal([x, v], [-other, -opposite])
    assert (x >= 0.5).all() and (x <= 1.5).all() and np.ptp(x) > 0.8
    np.testing.assert_allclose(np.sum(x * v, axis=-1), 0, atol=1e-14)
    r = np.linalg.norm(x, axis=1)
    # A pull of 1 / (2 r)² keeps a circle of radius r at the speed (4 r)^-½.
    change = crossed(x, v) / r * np.sqrt(4 * r) - 1
    assert 0.02 < change.std() < 0.09 and np.abs(change).max() < 0.25


@pytest.mark.slow
def test_three_bodies_leave_a_rotating_triangle():
    x, v = starts("three-body")
    r = np.linalg.norm(x, axis=-1)
    np.testing.assert_allclose(r, r[:, :1] * np.ones(3), rtol=1e-13)
    assert (r >= 0.9).all() and (r <= 1.2).all() and np.ptp(r) > 0.2
    np.testing.assert_allclose(np.linalg.norm(x[:, 0] - x[:, 1], axis=-1), np.sqrt(3) * r[:, 0], rtol=1e-13)
    assert (crossed(x[:, 0], x[:, 1]) > 0).all()
    # The pull of two bodies at the distance s = sqrt(3) r is 2 cos 30° / s² inward.
    speed = np.sqrt(r * 2 * np.cos(np.pi / 6) / (3 * r**2))[..., None]
    circular = speed * np.stack([-x[..., 1], x[..., 0]], axis=-1) / r[..., None]
    change = v / circular - 1
    assert np.abs(change).max() <= 0.2 + 1e-12
    assert change.std() == pytest.approx(0.2 / np.sqrt(3), rel=0.15)


def test_seeds_decide_and_the_first_start_is_the_published():
    again, other = hamiltonian_tasks.spring(3), hamiltonian_tasks.spring(0)
    np.testing.assert_array_equal(again.train.data.q, task("spring").train.data.q)
    assert np.abs(other.train.data.q - again.train.data.q).max() > 0.1
    # numpy's frozen generator, seed 0, begins with 0.5488135, 0.71518937, 0.60276338.
    direction = np.array([0.0976270, 0.43037873])
    expected = direction / np.hypot(*direction) * (0.1 + 0.9 * 0.60276338)
    np.testing.assert_allclose([other.train.clean.q[0, 0], other.train.clean.p[0, 0]], expected, rtol=1e-6)


def test_circular_orbits_are_keplers(monkeypatch):
    """Bodies at ±r turn at the rate (4 r³)^-½; more motions than a group, the last one not full."""
    monkeypatch.setattr(hamiltonian_tasks, "_GROUP", 20)
    r, t = np.linspace(0.6, 2.0, 30)[:, None], task("two-body").t
    rate, none = (4 * r**3) ** -0.5, 0 * r
    start = np.hstack([r, none, -r, none]), r * rate * np.array([0.0, 1, 0, -1])
    q, _ = reference_motion(task("two-body").hamiltonian, *start, t)
    expected = r[..., None] * np.stack([np.cos(rate * t), np.sin(rate * t)], axis=-1)
    np.testing.assert_allclose(q, np.concatenate([expected, -expected], axis=-1), rtol=0, atol=1e-8)


def test_mistakes_are_named():
    for call, message in [
        (lambda: hamiltonian_tasks.spring(trajectories=1), "trajectories is 1"),
        (lambda: hamiltonian_tasks.two_body(trajectories=4), "trajectories is 4"),
        (lambda: hamiltonian_tasks.pendulum(noise=-0.1), "noise is -0.1"),
        (lambda: reference_motion(None, *np.zeros((2, 1, 1)), np.zeros(1), tolerance=0.0), "tolerance is 0"),
        (lambda: n_body(1), "n is 1"),
        (lambda: n_body(3, masses=(1.0, 2.0)), "masses has 2"),
        (lambda: n_body(2, masses=(1.0, -2.0)), "mass 1 is -2"),
        (lambda: n_body(2, softening=-0.1), "softening is -0.1"),
        (lambda: mass_spring(mass=0.0), "mass is 0"),
    ]:
        with one_line(message):
            call()
