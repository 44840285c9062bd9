"""The pixel pendulum: renderer, state estimator, loss, latent energy, injection, animations, and a run end to end."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import assert_refused, command, json_of, one_line
from motions import quick_motion
from numpy.testing import assert_allclose, assert_array_equal

from dln_jax import HamiltonianSystem, Model, PlainFlow, flow, load
from dln_jax.commands import train_hnn_pixels
from dln_jax.figures import animations
from dln_jax.learning import frames as learning_frames
from dln_jax.learning.frames import Matching, TermWeights, problem, terms, windows
from dln_jax.mechanics.integrators import rk4, rollout
from dln_jax.metrics import frames as frame_metrics
from dln_jax.metrics.phase_space import Motions
from dln_jax.models.latent_phase import (
    LatentModel,
    LatentPhase,
    compress,
    latent_field,
    make_latent_phase,
    principal_components,
    through_components,
)
from dln_jax.precision import with_float64
from dln_jax.scenes.datasets import pendulum_frames
from dln_jax.scenes.datasets.pendulum_frames import FRAME_TIME, PIXELS, SIDE, energy, render, rod, split, swinging_rod
from dln_jax.scenes.scene import closed_form_forward_dynamics
from dln_jax.training.hamiltonian import pixels as pixel_task

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
        patch.setattr(frame_metrics, "predict", quick_predict)
        patch.setattr(pendulum_frames, "rollouts", quick_motions)
        yield
    pixel_task.pixel_data.cache_clear()


@pytest.fixture(scope="module")
def data():
    return swinging_rod(0, trajectories=6, frames=13)


def pictures64(q):
    return np.asarray(jax.jit(jax.vmap(lambda q: render(q).ravel()))(jnp.asarray(q)))


def test_renderer_draws_the_rod():
    """Bounded, mirrored for -q, moving where its derivative says, and bright exactly on the rod."""
    angles, h = jnp.array([0.35, -0.35, 1.3]), 1e-6
    image, slope = jax.jit(jax.vmap(lambda q: jax.jvp(render, (q,), (jnp.ones_like(q),))))(angles)
    assert image.shape == (3, SIDE, SIDE) and image.min() >= 0 and image.max() <= 1
    assert_allclose(image[1], image[0][:, ::-1], atol=1e-13)
    difference = (pictures64(angles + h) - pictures64(angles - h)) / (2 * h)
    assert_allclose(slope.reshape(3, -1), difference, atol=1e-8)
    # The tip of a rod of 1 m at q = 1.3 is at (0.96, -0.27), outside; half way down it is bright, elsewhere dark.
    row, column = (SIDE * np.array([0.4 + 0.5 * np.cos(1.3), 0.8 + 0.5 * np.sin(1.3)]) / 1.6).astype(int)
    assert image[2, row, column] > 0.9 and image[2, row, SIDE - 1 - column] < 1e-6


def test_data_are_repeatable_and_conserve_energy(data):
    assert_array_equal(data.frames, swinging_rod(0, trajectories=6, frames=13).frames)
    assert data.frames.dtype == np.float32 and data.frames.shape == (6, 13, PIXELS)
    levels = np.asarray(energy(jnp.asarray(data.q), jnp.asarray(data.qd)))
    assert np.ptp(levels, axis=1).max() < 1e-8 and levels.std() > 0.05
    assert_allclose(data.frames[3, 5], pictures64(data.q[3, 5:6])[0], atol=1e-7)
    assert_array_equal(data.pairs[2, 4], data.frames[2, 4:6].ravel())
    parts = split(data, seed=3)
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
    states = frame_metrics.physical_states(np.concatenate([*map(pictures64, angles[..., 0].T)], axis=1))
    assert_allclose(states[0], STATES[:, 0], atol=1e-9)
    assert_allclose(states[1], STATES[:, 1], atol=1e-6)
    # Frames of the data are float32.
    assert frame_metrics.energy_floor(data) < 1e-14
    assert frame_metrics.energy_errors(data.pairs, data._replace(q=2 * data.q)).min() > 1e-4


def oscillator(scale):
    """H = ½ p² + ½ w² q², w = 0.2 per frame, without a network; frames of one pixel are q times `scale`."""
    H = HamiltonianSystem(lambda q, p: jnp.sum(p**2 + 0.04 * q**2) / 2)
    field = Model(lambda key: jnp.ones(1), lambda parameters: H)

    def apply(factor):
        return LatentPhase(
            lambda x: (scale * x[:1], scale * factor * (x[1:] - x[:1])),
            lambda q, p: jnp.concatenate([q, q + 1.5 * p]) / scale,
            flow(H),
        )

    return LatentModel(field.init, apply, field)


def test_loss_by_hand():
    """Sums over samples in numpy, with the oscillator's motion in closed form."""
    frames = np.random.default_rng(0).normal(size=(4, 5, 1))
    factor, scale = 0.9, 2.0
    x, following = frames[:, :-1, 0], frames[:, 1:, 0]
    q, p = scale * x, scale * factor * (following - x)
    c, s = np.cos(0.2 * np.arange(1, 4)), np.sin(0.2 * np.arange(1, 4))
    image = np.mean(((q + 1.5 * p) / scale - following) ** 2) / 2
    change = np.mean((p[:, :-1] - np.diff(q, axis=1)) ** 2)
    moved = np.mean((q[:, :1] * c + p[:, :1] * s / 0.2 - q[:, 1:]) ** 2)
    pushed = np.mean((p[:, :1] * c - 0.2 * q[:, :1] * s - p[:, 1:]) ** 2)
    sizes = np.mean([x.var(), following.var()]), q.var(), p.var()
    for relative, (of_image, of_q, of_p) in ((True, sizes), (False, (1.0, 1.0, 1.0))):
        given = oscillator(scale), jnp.array([factor]), jnp.asarray(frames)
        found = terms(*given, relative)
        assert_allclose(found.autoencoder, image / of_image, rtol=1e-9)
        assert_allclose(found.coordinate, change / of_p, rtol=1e-9)
        assert_allclose(found.field, (moved / of_q + pushed / of_p) / 2, rtol=1e-4)
    matching = Matching(weights=TermWeights(2.0, 3.0, 5.0), relative=False)
    total = learning_frames.loss(given[0], matching, *given[1:])
    assert_allclose(total, 2 * found[0] + 3 * found[1] + 5 * found[2], rtol=1e-9)


def test_windows_are_segments_of_one_trajectory():
    frames = np.arange(2 * 7).reshape(2, 7, 1).astype(np.float32)
    assert_array_equal(windows(frames, 3)[..., 0], [[0, 1, 2], [3, 4, 5], [7, 8, 9], [10, 11, 12]])


def test_autoencoders_read_two_frames(data):
    """The momentum is the change of the coordinate, for any parameters."""
    model = make_latent_phase(latent_field("phase-network", width=3), PIXELS, width=5)
    system = model.apply(jax.jit(model.init)(jax.random.key(0)))
    first, second, other = data.frames[0, 0], data.frames[0, 1], data.frames[3, 2]
    pairs = jnp.asarray([[first, second], [first, other], [second, first]]).reshape(3, -1)
    q, p = jax.jit(jax.vmap(system.encode))(pairs)
    assert system.decode(q[0], p[0]).shape == (2 * PIXELS,) and abs(p[1] - p[0]) > 1e-6
    assert_allclose(q[2], q[0] + p[0], rtol=1e-5)
    assert_array_equal(q[1], q[0])


def test_components_keep_the_images(data):
    components = principal_components(data.frames, 12)
    assert_allclose(components.basis @ components.basis.T, np.eye(12), atol=1e-12)
    coefficients = compress(components, data.frames)
    assert coefficients.dtype == np.float32 and coefficients.shape == (6, 13, 12)
    assert_allclose(np.sqrt(np.mean(coefficients**2)), components.scale, rtol=1e-5)
    kept = components.mean + coefficients @ components.basis
    lost = np.mean((data.frames - kept) ** 2) / data.frames.var((0, 1)).mean()
    assert_allclose(lost, components.lost, rtol=1e-3)
    # A model of coefficients that gives back what it gets gives back frames.
    code = coefficients[0, :2].ravel().astype(float)
    echo = LatentPhase(lambda c: (c[:1], c[12:13]), lambda q, p: jnp.asarray(code), None)
    system = through_components(LatentModel(None, lambda _: echo, None), components).apply({})
    assert_allclose(system.encode(jnp.asarray(data.pairs[0, 0], float)), code[[[0], [12]]], atol=1e-5)
    assert_allclose(system.decode(jnp.zeros(1), jnp.zeros(1)), kept[0, :2].ravel(), atol=1e-6)


@pytest.mark.slow
def test_latent_motions_keep_the_energy(data):
    model = make_latent_phase(latent_field("black-box-hnn", width=6, depth=1), PIXELS, width=6)
    parameters = jax.jit(model.init)(jax.random.key(0))
    moved = frame_metrics.predict_frames(model, parameters, data.pairs[:2, 0], 30)
    assert moved.pairs.shape == (2, 30, 2 * PIXELS) and moved.frames.shape == (2, 30, PIXELS)
    H = flow(model.field.energies(with_float64(parameters["field"]))).energy
    levels = jax.jit(jax.vmap(jax.vmap(H)))(jnp.asarray(moved.latent.q), jnp.asarray(moved.latent.p))
    assert np.ptp(levels, axis=1).max() < 1e-9 and np.ptp(moved.latent.q, axis=1).min() > 1e-3


def test_injection_raises_the_energy_to_what_was_asked():
    """Along the gradient of q² + p² / 2 from (3, 4), q = 3 e^(2u) and p = 4 e^u."""
    raise_energy = jax.jit(frame_metrics.raise_energy, static_argnums=0)
    q, p = raise_energy(lambda q, p: jnp.sum(q**2 + p**2 / 2), jnp.array([3.0]), jnp.array([4.0]), 60.0)
    assert_allclose(q**2 + p**2 / 2, 60.0, rtol=1e-9)
    assert_allclose(q / 3, (p / 4) ** 2, rtol=1e-5)


def test_films_are_judged_by_the_motion_in_them(data):
    """The true film is good; one that stands still is refused."""
    latent = Motions(data.t, data.q[..., None], data.qd[..., None])
    still = np.broadcast_to(data.pairs[:, :1], data.pairs.shape)
    for film, level in ((data.pairs, "good"), (still, "refused")):
        assert pixel_task.judge_frames(frame_metrics.FrameMotions(latent, film), data).level == level


def test_a_run_is_judged_resumes_and_loads(tmp_path, monkeypatch, capsys):
    for name in ("FRAMES", "TRAJECTORIES"):
        monkeypatch.setattr(pixel_task, name, 13)
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
    pair = pixel_task.pixel_data().test.pairs[0, 0]
    q, p = system.encode(pair)
    assert system.decode(q, p).shape == pair.shape and isinstance(system.field, PlainFlow)
    assert np.isfinite(system.field.rates(q, p)).all()


def test_mistakes_are_named(data, tmp_path, capsys):
    rows = {"--model pairwise": "--model is 'pairwise'", "--steps 0": "steps is 0"}
    assert_refused(capsys, train_hnn_pixels, rows.items(), out=tmp_path / "no")
    frames, gif = data.frames, tmp_path / "a.gif"
    for message, call in {
        "trajectories is 0": lambda: swinging_rod(trajectories=0),
        "frames is 2; expected at least 3": lambda: swinging_rod(frames=2),
        "leave none for training": lambda: split(data, test_share=0.9),
        "components is 0": lambda: principal_components(frames, 0),
        "at least the 21 of a window": lambda: problem(oscillator(1.0), frames, frames, Matching(window=20)),
        "hnn has 13 samples for 2 times": lambda: animations.write_frame_gif(gif, {"hnn": frames[0]}, np.zeros(2)),
    }.items():
        with one_line(message):
            call()
