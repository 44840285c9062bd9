"""Locomotion: the task, its environment, and the learning, on a body of six vertices and short episodes."""

import functools
import os
import signal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import assert_refused, json_of, one_line
from gymnasium.utils.env_checker import check_env
from jax.sharding import Mesh
from PIL import Image

from dln_jax.commands import train_locomotion
from dln_jax.figures.soft_bodies import soft_body_drawing
from dln_jax.figures.style import write_gif
from dln_jax.locomotion import learning
from dln_jax.locomotion.gradient import GradientSettings, make_policy, make_updates, targets
from dln_jax.locomotion.learning import Learned, Record, learn, make_learner, train
from dln_jax.locomotion.task import (
    FALLEN,
    Frame,
    Walk,
    advance,
    axes_of,
    beginning,
    fitted_frame,
    judged,
    make_task,
)
from dln_jax.locomotion.worlds import Variation
from dln_jax.scale import AXIS
from dln_jax.softbody.contact.obstacles import half_space, obstacle_contact
from dln_jax.softbody.mesh.mesh import make_mesh
from dln_jax.softbody.mesh.shapes import Creature, lattice, translate
from dln_jax.softbody.scene import make_scene
from dln_jax.softbody.terms.elasticity import elastic
from dln_jax.softbody.terms.loads import gravity
from dln_jax.softbody.terms.springs import muscles
from dln_jax.softbody.terms.strain_energies import stable_neo_hookean
from scripts.reports.cases.locomotion import CreatureEnvironment

EPISODE = 12
WINDOW = 6
STEPS = 10_000
QUICK = GradientSettings(width=3, window=WINDOW, lanes=2, learning_rate=0.05, updates=4, value_fits=4)


@pytest.fixture(scope="module")
def task():
    """The smallest creature: a block of two cells that two muscles along its sides bend, and short episodes."""
    positions, triangles = lattice([(0, 0), (1, 0)])
    mesh = make_mesh(0.4 * np.asarray(positions, float), triangles)
    number = {tuple(place): index for index, place in enumerate(np.asarray(positions).tolist())}
    muscles = np.array([[number[0, 0], number[0, 1]], [number[0, 1], number[1, 1]]])
    return make_task(Creature("block", mesh, muscles), episode=EPISODE, clock_period=6.0, upright=0.04)


@pytest.fixture(scope="module")
def policy(task):
    return make_policy(task, width=3)


@pytest.fixture(scope="module")
def learner(task, policy):
    return make_learner(task, policy, QUICK, steps=STEPS)


@pytest.fixture(scope="module")
def environment(task):
    return CreatureEnvironment(task)


@pytest.mark.slow
def test_a_scene_of_ones_own_has_gradients(task):
    """Another material, a barrier as the ground, and another time step."""
    creature = task.creature
    mesh = translate(creature.mesh, [0.0, 0.02])
    terms = (
        elastic(mesh, stable_neo_hookean, youngs_modulus=2e3),
        gravity(mesh),
        muscles(creature.muscles, stiffness=90),
    )
    ground = obstacle_contact(mesh, half_space([0.0, 1.0]), distance=0.01, stiffness=1e3)
    other = make_task(creature, scene=make_scene(mesh, terms, contacts=[ground]), dt=0.02)
    slope = jax.jit(jax.grad(lambda change: advance(other, beginning(other), change)[1].reward))(-jnp.ones(2) / 5)
    assert np.isfinite(slope).all() and np.any(slope)


def same(one, other):
    return all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True))


@pytest.mark.filterwarnings("error", "ignore:.*infinity")
def test_the_environment_passes_gymnasiums_checks(environment):
    check_env(environment, skip_render_check=True)
    with one_line("the options slope; this environment has none"):
        environment.reset(options={"slope": 3.0})


def test_reward_is_the_displacement_up_to_a_speed_less_the_posture(environment, task):
    environment.reset(seed=0)
    rest = task.creature.mesh.vertices
    x, random = rest, np.random.default_rng(0)
    for count in range(1, EPISODE + 1):
        _, reward, terminated, truncated, info = environment.step(random.uniform(-1, 1, 2).astype(np.float32))
        after = info["x"]
        # The affine map by least squares, whose image of x is the body's axis.
        linear = np.linalg.lstsq(rest - rest.mean(0), after - after.mean(0))[0].T
        a = linear[:, 0] / np.linalg.norm(linear[:, 0])
        posture = 1 - a[0] + 25 * max(0, 0.8 - after[:, 1].mean() / rest[:, 1].mean()) ** 2
        displacement = (after[:, 0].mean() - x[:, 0].mean()) / task.length
        worth = 0.04 * np.tanh(displacement / 0.04)
        np.testing.assert_allclose(reward, worth - task.upright * posture, rtol=1e-9, atol=1e-12)
        assert not terminated and truncated == (count == EPISODE) and info["converged"]
        x = after


@pytest.mark.parametrize("dimension", [2, 3])
def test_observations_do_not_change_if_the_body_is_moved_or_turned(dimension):
    random = np.random.default_rng(0)
    vertices = random.normal(size=(6, dimension))
    x = vertices + 0.1 * random.normal(size=vertices.shape)
    rotation, _ = np.linalg.qr(random.normal(size=(dimension, dimension)))
    rotation[:, 0] *= np.linalg.det(rotation)
    corners = np.eye(6)[:dimension]
    for frame in (fitted_frame(vertices), Frame(corners[0], corners[1:] - corners[0])):
        axes = jax.jit(functools.partial(axes_of, frame))
        seen = [(at - frame.origin @ at) @ axes(at).T for at in (x, x @ rotation.T + 3.0)]
        np.testing.assert_allclose(seen[0], seen[1], atol=1e-12)
        R = axes(x)
        np.testing.assert_allclose(R @ R.T, np.eye(dimension), atol=1e-12)
        assert np.linalg.det(R) > 0


@pytest.mark.slow
def test_actuation_changes_by_at_most_0_3_and_stays_in_range(task):
    step = jax.jit(functools.partial(advance, task))
    place, _ = step(beginning(task), jnp.asarray([-1.0, 1.0]))
    np.testing.assert_allclose(place.actuation, [0.7, 1.0])
    for _ in range(3):
        place, _ = step(place, jnp.asarray([-1.0, -0.1]))
    np.testing.assert_allclose(place.actuation, [0.25, 0.7])


def test_what_a_fallen_body_travels_does_not_count():
    tilt = jnp.asarray([0.0, 0.9 * FALLEN, 1.1 * FALLEN, 0.0])
    seen = Walk(jnp.zeros((4, 6, 2)), jnp.ones((4, 2)), jnp.ones(4, bool), jnp.full(4, 0.1), jnp.zeros(4), tilt)
    distance, steps = judged(seen)
    np.testing.assert_allclose(distance, 0.2, rtol=1e-12)
    assert steps == 2
    before, later = (judged(seen._replace(converged=jnp.arange(4) != step))[0] for step in (1, 3))
    assert np.isnan(before) and not np.isnan(later)


def test_targets_are_the_sum_over_n_step_returns():
    random = np.random.default_rng(0)
    rewards, values, g, k = random.normal(size=5), random.normal(size=6), 0.9, 0.7
    n_step = [sum(g**t * rewards[t] for t in range(n)) + g**n * values[n] for n in range(1, 6)]
    expected = sum((1 - k) * k**n * n_step[n] for n in range(4)) + k**4 * n_step[4]
    np.testing.assert_allclose(
        targets(jnp.asarray(rewards), jnp.ones(6), jnp.asarray(values), g, k)[0], expected, rtol=1e-12
    )
    alive = jnp.asarray([1.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    first = rewards[0] + g * ((1 - k) * values[1] + k * rewards[1])
    np.testing.assert_allclose(targets(jnp.asarray(rewards), alive, jnp.asarray(values), g, k)[0], first, rtol=1e-12)


def test_a_slope_is_a_direction_of_gravity_and_flat_worlds_hold_nothing(task):
    steep = task._replace(variation=Variation(slope=10.0))
    ups = [beginning(steep, jax.random.key(seed), steepest=True).world.gravity / 9.8 for seed in range(8)]
    assert {round(float(up[0]), 6) for up in ups} == {0.173648, -0.173648}
    np.testing.assert_allclose([up[1] for up in ups], -0.984808, atol=1e-6)
    assert beginning(task).world == (None, None, None, None)


def test_gradients_increase_the_distance_and_the_same_seed_gives_the_same(learner):
    first = learn(learner, seed=0, steps=20 * learner.steps)
    assert first.distance > max(0.005, 2 * first.records[0].distance)
    assert [record.steps for record in first.records] == [48 * (n + 1) for n in range(20)]
    assert first.records[-1].skipped == 0
    again, other = (learn(learner, seed=seed, steps=2 * learner.steps) for seed in (0, 1))
    assert [r.distance for r in again.records] == [r.distance for r in first.records[:2]]
    assert [r.distance for r in other.records] != [r.distance for r in first.records[:2]]


def test_an_interrupt_waits_for_the_checkpoint_and_a_resumed_run_continues_bit_for_bit(learner, tmp_path):
    # A shell that starts the tests in the background has them ignore interrupts.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)

    def learned(learner, folder, width=3, **keywords):
        folder.mkdir(exist_ok=True)
        steps, settings = 3 * learner.steps, {"width": width}
        return learn(learner, seed=3, steps=steps, directory=folder, settings=settings, **keywords)

    def interrupted(state):
        os.kill(os.getpid(), signal.SIGINT)
        return learner.improve(state)

    with pytest.raises(KeyboardInterrupt):
        learned(learner._replace(improve=interrupted), tmp_path / "parts")
    signal.signal(signal.SIGINT, before)
    assert len(json_of(tmp_path / "parts" / "checkpoint-3.json")["records"]) == 1
    continued, whole = learned(learner, tmp_path / "parts", resume=True), learned(learner, tmp_path / "whole")
    assert [r.distance for r in continued.records] == [r.distance for r in whole.records]
    assert same(continued.parameters, whole.parameters)
    with one_line("other settings"):
        learned(learner, tmp_path / "parts", width=4, resume=True)
    with one_line("resume needs the directory"):
        learn(learner, seed=3, steps=999, resume=True)


def test_training_further_begins_at_the_stored_policy(task, policy, monkeypatch):
    policies, initial = [], policy.init(jax.random.key(9))
    monkeypatch.setattr(learning, "make_learner", lambda task, policy, *_, **__: policies.append(policy))
    train(task, seeds=[], steps=1, settings=QUICK, initial=initial)
    train(task, seeds=[], steps=1, settings=QUICK)
    further, new = (make_updates(task, policy, QUICK, steps=1)[0](0).averaged for policy in policies)
    assert same(further, initial) and not same(new, initial)


def test_the_rate_falls_and_averages_follow_the_parameters(learner):
    def away(one, other):
        return max(np.abs(a - b).max() for a, b in zip(*map(jax.tree.leaves, (one, other)), strict=True))

    state = learner.start(0)
    late = state._replace(optimiser=jax.tree.map(lambda a: a + 10**6 * (a.dtype.kind == "i"), state.optimiser))
    after, after_late = map(learner.improve, (state, late))
    moved = away(state.parameters, after.parameters)
    assert 0 < away(after.averaged, after.parameters) < moved
    assert 0 < away(state.parameters, after_late.parameters) < 0.1 * moved


def test_selection_prefers_starts_that_succeed_and_then_distance():
    records = [Record(1, 1.0, 9.0, 0, 0.5), Record(2, 2.0, 3.0, 0, 1.0), Record(3, 3.0, np.nan, 0, 1.0)]
    learned = Learned({}, [*records, Record(4, 4.0, 5.0, 0, 1.0), Record(5, 5.0, 4.0, 0, 1.0)], 0.0)
    assert learned.selected.steps == 4 and learned.distance == 5.0
    assert Learned({}, records[2:], 0.0).selected is None


def test_updates_without_a_gradient_are_skipped_and_counted(learner):
    state = learner.start(0)
    x = state.lanes.state.x
    lost = state._replace(lanes=state.lanes._replace(state=state.lanes.state._replace(x=x.at[0, 0, 0].set(jnp.nan))))
    after = learner.improve(lost)
    # The lane is restarted, so that the next updates are usable.
    assert after.skipped == 1 and after.updates == QUICK.updates
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(after))
    assert not same(after.parameters, state.parameters)


def test_mistakes_are_one_line(capsys, tmp_path):
    rows = [
        ("--steps 0", "steps is 0"),
        ("--upright -1", "--upright is -1"),
        ("--resume", "holds none"),
        ("--window 0", "window is 0"),
        ("--slope 90", "slope is 90"),
        ("--push nan", "push is nan"),
        ("--seed -1", "seed is -1"),
        ("--seed 4294967295 --seeds 2", "and 1 after it"),
    ]
    assert_refused(capsys, train_locomotion, rows, out=tmp_path / "run")


def test_devices_that_do_not_divide_the_creatures_are_refused(task, policy):
    mesh = Mesh(np.array(7 * jax.devices()[:1]), (AXIS,))
    with one_line("creatures side by side cannot be split over 7 devices"):
        make_updates(task, policy, QUICK, steps=STEPS, mesh=mesh)


def test_animations_hold_their_frames_and_refuse_what_does_not_fit(task, tmp_path):
    mesh, muscles, path = task.creature.mesh, task.creature.muscles, tmp_path / "walk.gif"
    x, t = np.stack([mesh.vertices + np.array([0.1 * frame, 0]) for frame in range(5)]), 0.1 * np.arange(5)
    drawing = soft_body_drawing(mesh, x, muscles=muscles, actuation=np.full((5, 2), 0.5))
    write_gif(path, *drawing, t, frames=range(0, 5, 2), frames_per_second=15.0, title="block")
    assert Image.open(path).n_frames == 3
    with one_line("positions have shape"):
        soft_body_drawing(mesh, x[:, :4])
    with one_line("actuation has shape"):
        soft_body_drawing(mesh, x, muscles=muscles, actuation=np.ones((5, 3)))
