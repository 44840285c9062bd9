"""Learning from a growing record: one program for all sizes, exact where the model is linear, and refusals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line

from dln_jax.learning.online import (
    Replay,
    append_recording,
    empty_replay,
    learn_online,
    make_linear_refit,
    make_refit,
)
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.model import make_delan
from dln_jax.models.trigonometric import make_planar_chain
from dln_jax.scenes.datasets import generators
from dln_jax.scenes.pendulums import two_link_arm

NEEDS = two_link_arm().needs
BOUNDS = {"position_bound": 1.0, "rate_bound": 1.0, "acceleration_bound": 3.0}


def recordings(count, samples=20):
    data = generators.uniform(two_link_arm(), samples=count * samples, **BOUNDS)
    arrays = (data.q, data.qd, data.qdd, data.tau)
    return [tuple(each[n * samples : (n + 1) * samples] for each in arrays) for n in range(count)]


def grown(capacity, parts):
    replay = empty_replay(capacity, 2)
    for part in parts:
        replay = append_recording(replay, *part)
    return replay


def torque_error(model, parameters, part):
    q, qd, qdd, tau = part
    torque = jax.jit(lambda p, *x: jax.vmap(dynamics(model.energies(p)).inverse_dynamics)(*x))
    return float(np.abs(np.asarray(torque(parameters, q, qd, qdd)) - tau).max())


@pytest.mark.slow
def test_contents_of_empty_places_have_no_effect():
    network = make_delan(NEEDS, width=4, depth=1, dtype=jnp.float64)
    refit, replay = make_refit(network, rounds=3, iterations=4), grown(100, recordings(2))
    rows = np.arange(100)[:, None] >= replay.recorded
    other = Replay(*(np.where(rows, 0.3, each) for each in replay[:4]), replay.fitted, replay.held_out)
    start = jax.jit(network.init)(jax.random.key(1))
    for one, two in zip(*(jax.tree.leaves(refit(start, each)) for each in (replay, other)), strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-6, atol=1e-8)
    refit(start, grown(100, recordings(3)))
    assert refit._cache_size() == 1, "data that grow share one program"


def test_a_linear_model_is_exact_after_one_recording():
    (first, second, test), model = recordings(3), make_planar_chain(NEEDS._replace(friction=True), symmetric=False)
    refit, replay, parameters = make_linear_refit(model), empty_replay(60, 2), model.init(jax.random.key(0))
    assert torque_error(model, parameters, test) > 1
    for part in (first, second):
        replay = append_recording(replay, *part)
        parameters = refit(parameters, replay)
        assert torque_error(model, parameters, test) < 1e-11
    np.testing.assert_allclose(parameters.viscous, 0, atol=1e-11)


def test_one_block_of_each_recording_is_held_out():
    replay = grown(50, recordings(2))
    np.testing.assert_array_equal(np.flatnonzero(replay.held_out), [10, 11, 30, 31])
    np.testing.assert_array_equal(replay.fitted[:40] + replay.held_out[:40], 1)
    assert not replay.fitted[40:].any() and not replay.held_out[40:].any()
    assert not append_recording(empty_replay(5, 2), *(x[:3] for x in recordings(1)[0])).held_out.any()


def test_recordings_that_do_not_fit_are_refused():
    (part,), replay = recordings(1), empty_replay(30, 2)
    for call, message in [
        (lambda: append_recording(append_recording(replay, *part), *part), "10 empty places for 20 samples"),
        (lambda: append_recording(replay, *part[:3], np.full_like(part[3], np.nan)), "not finite"),
        (lambda: append_recording(replay, *part[:3], part[3][:, :1]), r"\(20, 1\).*expected \[n, 2\] for all"),
        (lambda: empty_replay(0, 2), "capacity"),
    ]:
        with one_line(message):
            call()


def test_each_reference_is_driven_with_what_was_learned_before():
    (part,) = recordings(1, samples=5)
    nothing = tuple(each[:0] for each in part)
    drive = lambda parameters, reference: (parameters, part if reference == "long" else nothing)  # noqa: E731
    refit = lambda parameters, replay: parameters + replay.recorded  # noqa: E731
    visits = list(learn_online(["long", "short", "long"], drive, refit, 0, empty_replay(12, 2)))
    assert [visit[:2] for visit in visits] == [(0, 5), (5, 5), (5, 15)]
    assert visits[-1][2].recorded == 10
