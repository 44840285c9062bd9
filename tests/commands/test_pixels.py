"""The pixel pendulum: renderer, state estimator, loss, latent energy, injection, animations, and a run end to end."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import assert_refused, command, json_of
from motions import quick_motion
from numpy.testing import assert_allclose, assert_array_equal

from dln_jax import HamiltonianSystem, flow, load
from dln_jax.commands import pixel_films, pixels, train_hnn_pixels
from dln_jax.commands.pixel_films import FRAME_TIME, PIXELS, SIDE, energy, render, rod, swinging_rod
from dln_jax.mechanics.dynamics import PhaseRates
from dln_jax.mechanics.integrators import rk4, rollout
from dln_jax.metrics.phase_space import Motions
from dln_jax.models.latent_phase import LatentPhase, make_image_model
from dln_jax.precision import with_float64
from dln_jax.scenes.scene import closed_form_forward_dynamics

STATES = np.array([[0.0, 0.0], [0.3, -1.2], [-0.55, 0.7], [1.4, 3.0], [-2.9, 4.0], [3.1, -2.0]])
"""q in rad and qd in rad/s, around the whole circle."""


def quick_motions(scene, q, qd, t):
    """In place of `rollouts`, which takes seconds to compile; H = 3/2 p² - 5 cos q of the rod."""
    q, p = quick_motion(lambda q, p: 1.5 * p @ p - 5 * jnp.cos(q[0]), q, qd / 3, t)
    return q, 3 * p


def quick_predict(model, parameters, q, p, t):
    """In place of `predict`, for the same reason: RK4."""
    step = rk4(lambda t, state: flow(model.energies(parameters)).rates(*state))
    motion = jax.jit(jax.vmap(lambda q, p: rollout(step, (q, p), jnp.asarray(t), substeps=4)))
    return Motions(t, *(np.asarray(state) for state in motion(jnp.asarray(q), jnp.asarray(p))))


@pytest.fixture(scope="module", autouse=True)
def _quick():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pixel_films, "predict", quick_predict)
        patch.setattr(pixel_films, "rollouts", quick_motions)
        yield


@pytest.fixture(scope="module")
def data():
    return swinging_rod(6, 13)[0]


def pictures64(q):
    return np.asarray(jax.jit(jax.vmap(render))(jnp.asarray(q)))


def test_renderer_draws_the_rod():
    """Bounded, mirrored for -q, moving where its derivative says, and bright exactly on the rod."""
    angles, h = jnp.array([0.35, -0.35, 1.3]), 1e-6
    image, slope = jax.jit(jax.vmap(lambda q: jax.jvp(render, (q,), (jnp.ones_like(q),))))(angles)
    assert image.min() >= 0 and image.max() <= 1
    image = image.reshape(3, SIDE, SIDE)
    assert_allclose(image[1], image[0][:, ::-1], atol=1e-13)
    difference = (pictures64(angles + h) - pictures64(angles - h)) / (2 * h)
    assert_allclose(slope, difference, atol=1e-8)
    # The tip of a rod of 1 m at q = 1.3 is at (0.96, -0.27), outside; half way down it is bright, elsewhere dark.
    row, column = (SIDE * np.array([0.4 + 0.5 * np.cos(1.3), 0.8 + 0.5 * np.sin(1.3)]) / 1.6).astype(int)
    assert image[2, row, column] > 0.9 and image[2, row, SIDE - 1 - column] < 1e-6


def test_data_are_repeatable_and_conserve_energy(data):
    parts = swinging_rod(6, 13)
    assert_array_equal(data.frames, parts[0].frames)
    assert data.frames.dtype == np.float32 and data.frames.shape == (4, 13, PIXELS)
    levels = energy(data.q, data.qd)
    assert np.ptp(levels, axis=1).max() < 1e-8 and levels.std() > 0.05
    assert_allclose(data.frames[3, 5], pictures64(data.q[3, 5:6])[0], atol=1e-7)
    assert_array_equal(data.pairs[2, 4], data.frames[2, 4:6].ravel())
    assert [len(part.q) for part in parts] == [4, 1, 1]
    assert len(set(np.concatenate([part.q[:, 0] for part in parts]))) == 6


def test_the_point_pendulum_is_gyms_rod():
    """Inertia 1/3 kg m², and a weight of 10 N that acts half way: d/dt (qd / 3) = -5 sin q."""
    q, qd = jnp.array([0.7]), jnp.array([1.3])
    scene = rod()
    assert_allclose(closed_form_forward_dynamics(scene, q, qd, jnp.zeros(1)), -15 * np.sin(q), rtol=1e-12)
    total = 0.5 * qd @ scene.mass_matrix(q) @ qd + scene.potential(q)
    assert_allclose(energy(q, qd)[0], total, rtol=1e-12)


def test_estimator_recovers_states(data):
    angles, _ = quick_motions(rod(), STATES[:, :1], STATES[:, 1:], np.array([0.0, FRAME_TIME]))
    states = pixel_films.physical_states(np.concatenate([*map(pictures64, angles[..., 0].T)], axis=1))
    assert_allclose(states[0], STATES[:, 0], atol=1e-9)
    assert_allclose(states[1], STATES[:, 1], atol=1e-6)
    # Frames of the data are float32.
    for q, wrong in ((data.q, False), (2 * data.q, True)):
        errors = pixel_films.energy_errors(data.pairs, energy(q, data.qd)[:, :-1])
        assert errors.min() > 1e-4 if wrong else errors.mean() < 1e-14


def oscillator(scale, factor):
    """H = ½ p² + ½ w² q², w = 0.2 per frame, without a network; frames of one pixel are q times `scale`."""
    H = HamiltonianSystem(lambda q, p: jnp.sum(p**2 + 0.04 * q**2) / 2)
    return LatentPhase(
        lambda x: (scale * x[:1], scale * factor * (x[1:] - x[:1])),
        lambda q, p: jnp.concatenate([q, q + 1.5 * p]) / scale,
        flow(H),
    )


def test_loss_by_hand():
    """Sums over samples in numpy, with the oscillator's motion in closed form."""
    films = np.random.default_rng(0).normal(size=(4, 5, 1))
    factor, scale = 0.9, 2.0
    x, following = films[:, :-1, 0], films[:, 1:, 0]
    q, p = scale * x, scale * factor * (following - x)
    c, s = np.cos(0.2 * np.arange(1, 4)), np.sin(0.2 * np.arange(1, 4))
    image = np.mean(((q + 1.5 * p) / scale - following) ** 2) / 2
    change = np.mean((p[:, :-1] - np.diff(q, axis=1)) ** 2)
    moved = np.mean((q[:, :1] * c + p[:, :1] * s / 0.2 - q[:, 1:]) ** 2)
    pushed = np.mean((p[:, :1] * c - 0.2 * q[:, :1] * s - p[:, 1:]) ** 2)
    of_image, of_q, of_p = np.mean([x.var(), following.var()]), q.var(), p.var()
    given = oscillator(scale, factor), jnp.asarray(films)
    found = pixels.terms(*given)
    expected = image / of_image, change / of_p, (moved / of_q + pushed / of_p) / 2
    for ours, theirs, tolerance in zip(found, expected, (1e-9, 1e-9, 1e-4), strict=True):
        assert_allclose(ours, theirs, rtol=tolerance)
    assert_allclose(pixels.loss(*given), found[0] + found[1] + 10 * found[2], rtol=1e-9)


def test_windows_are_segments_of_one_trajectory():
    assert_array_equal(
        pixels.windows_of(np.arange(2 * 7).reshape(2, 7, 1))[..., 0], [[0, 1, 2], [3, 4, 5], [7, 8, 9], [10, 11, 12]]
    )


def small_model(field, components):
    """A model of frames with few components, and its parameters."""
    size = {"pixels": PIXELS, "components": components, "width": 5, "field_width": 3, "field_depth": 1}
    model = make_image_model(field=field, **size)
    return model, jax.jit(model.init)(jax.random.key(0))


def test_autoencoders_read_two_frames(data):
    """The momentum is the change of the coordinate, for any parameters."""
    model, parameters = small_model("phase-network", 4)
    system = model.images(parameters | {"components": pixels.principal_components(data.frames, 4)})
    first, second, other = data.frames[0, 0], data.frames[0, 1], data.frames[3, 2]
    pairs = jnp.asarray([[first, second], [first, other], [second, first]]).reshape(3, -1)
    q, p = jax.jit(jax.vmap(system.encode))(pairs)
    assert system.decode(q[0], p[0]).shape == (2 * PIXELS,) and abs(p[1] - p[0]) > 1e-6
    assert_allclose(q[2], q[0] + p[0], rtol=1e-5)
    assert_array_equal(q[1], q[0])


def test_components_keep_the_images(data):
    components = pixels.principal_components(data.frames, 12)
    basis, mean = components["basis"], components["mean"]
    assert_allclose(basis @ basis.T, np.eye(12), atol=1e-12)
    coefficients = pixels.compress(components, data.frames)
    assert coefficients.dtype == np.float32 and coefficients.shape == (4, 13, 12)
    assert_allclose(np.sqrt(np.mean(coefficients**2)), components["scale"], rtol=1e-5)
    kept = mean + coefficients @ basis
    assert np.mean((data.frames - kept) ** 2) < 0.02 * data.frames.var((0, 1)).mean()
    # A model of images is that of their coefficients, between the frames and these.
    model, parameters = small_model("phase-network", 12)
    inner = model.coefficients(parameters["parameters"], components["scale"])
    system = model.images(parameters | {"components": components})
    code = jnp.asarray(coefficients[0, :2].ravel(), float)
    q, p = inner.encode(code)
    assert_allclose(system.encode(jnp.asarray(data.pairs[0, 0], float)), (q, p), atol=1e-5)
    back = mean + inner.decode(q, p).reshape(2, 12) @ basis
    assert_allclose(system.decode(q, p), back.ravel(), atol=1e-6)


@pytest.mark.slow
def test_latent_motions_keep_the_energy(data):
    model, parameters = small_model("black-box-hnn", 4)
    parameters |= {"components": pixels.principal_components(data.frames, 4)}
    numbers, films = pixel_films.film_errors(model, parameters, data)
    assert films.shape == data.pairs.shape and numbers["energy_mse"] > numbers["energy_floor"]
    field = with_float64(parameters["parameters"]["field"])
    moved = quick_predict(model.field, field, jnp.array([[0.3], [-1.0]]), jnp.array([[0.1], [0.2]]), np.arange(30.0))
    H = flow(model.field.energies(field)).energy
    levels = jax.jit(jax.vmap(jax.vmap(H)))(jnp.asarray(moved.q), jnp.asarray(moved.p))
    assert np.ptp(levels, axis=1).max() < 1e-9 and np.ptp(moved.q, axis=1).min() > 1e-3


def test_injection_raises_the_energy_to_what_was_asked():
    """Along the gradient of q² + p² / 2 from (3, 4), q = 3 e^(2u) and p = 4 e^u."""
    raise_energy = jax.jit(pixel_films.raise_energy, static_argnums=0)
    q, p = raise_energy(lambda q, p: jnp.sum(q**2 + p**2 / 2), jnp.array([3.0]), jnp.array([4.0]), 60.0)
    assert_allclose(q**2 + p**2 / 2, 60.0, rtol=1e-9)
    assert_allclose(q / 3, (p / 4) ** 2, rtol=1e-5)


def test_films_are_judged_by_the_motion_in_them(data):
    """The true film is good; one that stands still is refused."""
    still = np.broadcast_to(data.pairs[:, :1], data.pairs.shape)
    for film, level in ((data.pairs, "good"), (still, "refused")):
        assert pixel_films.judge_films(film, data).level == level


def test_a_run_is_judged_resumes_and_loads(tmp_path, monkeypatch, capsys):
    films = swinging_rod(13, 13)
    monkeypatch.setattr(pixel_films, "swinging_rod", lambda _: films)
    run = tmp_path / "run"
    command(train_hnn_pixels, "--model phase-network --steps 1 --out", run)
    assert "verdict: refused" in capsys.readouterr().out
    numbers = json_of(run / "metrics.json")
    assert numbers["energy_mse"] > numbers["energy_floor"] and numbers["parameters"] > 1e5
    assert (run / "pixels.gif").stat().st_size > 1000
    stored = (run / "model.safetensors").read_bytes()
    (run / "model.safetensors").unlink()
    command(train_hnn_pixels, "--resume --no-figures --out", run)
    assert (run / "model.safetensors").read_bytes() == stored
    system = load(run).images
    pair = films[2].pairs[0, 0]
    q, p = system.encode(pair)
    assert system.decode(q, p).shape == pair.shape and isinstance(system.field, PhaseRates)
    assert np.isfinite(system.field.rates(q, p)).all()


def test_mistakes_are_named(tmp_path, capsys):
    rows = {"--model pairwise": "--model is 'pairwise'", "--steps 0": "steps is 0", "--trajectories 2": "at least 3"}
    assert_refused(capsys, train_hnn_pixels, rows.items(), out=tmp_path / "no")
