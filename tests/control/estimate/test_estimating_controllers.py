"""Controllers with a filter use late measurements at their own time, and act on the state of the moment of action."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from numpy.testing import assert_allclose

import dln_jax
from dln_jax.control.closed_loop import Controller, stateless
from dln_jax.control.estimate.kalman import belief, filtered, mechanical
from dln_jax.control.observers import with_estimate
from dln_jax.control.state_space import field_of, integrated
from dln_jax.export.c.interface import stated_costs
from dln_jax.export.c.load import load_c
from dln_jax.export.c.source import export_c
from dln_jax.scenes.pendulums import cart_pole

SCENE = cart_pole()
MODEL, B = dln_jax.dynamics(SCENE.closed_form), np.array(SCENE.needs.actuation)
FIELD = field_of(MODEL, B)
PROCESS = mechanical(MODEL, B, rate=100.0, band=[0.2, 0.01], encoder_noise=[1e-3, 2e-3])
SHARP = PROCESS._replace(noise=np.array([1e-7, 1e-7]), disturbance=np.array([1e-6, 1e-6]))
PRIOR = belief([0.0, np.pi, 0.0, 0.0], [0.01, 0.05, 0.05, 0.1])
EXACT = belief([0.0, np.pi, 0.0, 0.0], 1e-6)
ASKED = stateless(lambda x: jnp.array([1.0]) * jnp.sin(3 * x[0] + x[2] + 1.0))
IDLE = stateless(lambda x: 0.0 * x[:1])
"""It does not depend on the state, so that prompt and late loops have the same controls."""


def estimating(law, process=PROCESS, prior=PRIOR, **settings):
    return with_estimate(law, process, prior, **{"rate": 100.0, "controls": 1, **settings})


def replay(controller):
    """(measurements, times, by default at 100 Hz) -> estimates and controls of a controller."""

    def sample(memory, row):
        memory, u = controller.act(memory, *row)
        return memory, (memory[0], u)

    run = jax.jit(lambda t, y: jax.lax.scan(sample, controller.start, (t, y))[1])
    return lambda y, t=None: run(np.arange(len(y)) / 100.0 if t is None else t, y)


def measurements(samples=60):
    random = np.random.default_rng(0)
    slow = np.cumsum(np.cumsum(random.normal(size=(samples, 2)), axis=0), axis=0) * [2e-4, 4e-4]
    return jnp.asarray(slow + np.array([0.0, np.pi]))


def test_late_and_rare_measurements_give_the_estimates_of_a_filter_that_knows_their_times():
    y = measurements()
    direct = jax.jit(lambda seen: filtered(PROCESS, PRIOR, y, jnp.zeros((len(y), 1)), seen)[0])
    shifted = jnp.stack([jnp.roll(y[:, 0], 1), jnp.roll(y[:, 1], 3)], axis=1)
    delayed, _ = replay(estimating(IDLE, late=(1, 3)))(shifted)
    # At sample k the late loop knows channel 0 up to k - 1 and channel 1 up to k - 3: filter that log directly.
    every = np.ones((len(y), 2), bool)
    for k in (10, 40):
        seen = every.copy()
        seen[k] = False
        seen[k - 2 : k, 1] = False
        assert_allclose(delayed[k], direct(seen)[k], rtol=0, atol=1e-12)
    assert np.abs(delayed - direct(every)).max() > 1e-4
    rare = replay(estimating(IDLE, every=(1, 4)))
    every[:, 1] = np.arange(len(y)) % 4 == 0
    assert_allclose(rare(y)[0], direct(every), rtol=0, atol=1e-12)
    # A failed measurement is not hidden.
    _, u = rare(y.at[30, 0].set(jnp.nan))
    assert np.isfinite(u[:30]).all() and np.isnan(u[30:]).all()


def test_a_law_behind_a_delay_acts_on_the_state_in_which_its_control_takes_effect():
    """The plant takes every control one and a half samples late."""
    controller = estimating(ASKED, SHARP, EXACT, delay=1.5)
    half = jax.jit(integrated(FIELD, 0.005))
    act = jax.jit(controller.act)
    memory = controller.start
    x = np.asarray(EXACT.x)
    errors = []
    controls = [np.zeros(1), np.zeros(1)]
    for number in range(50):
        memory, u = act(memory, number / 100.0, x[:2])
        x = half(half(x, controls[-2]), controls[-1])
        controls.append(u)
        # Half a sample from now the control of the sample before gives way to this one.
        errors.append(u[0] - ASKED.act((), jnp.zeros(()), half(x, controls[-2]))[1][0])
    # The plant knows when the control changes; the filter knows the mean over the sample.
    assert np.abs(errors).max() < 2e-3


def test_filters_use_the_times_of_samples_and_of_controls():
    """Controls act 1.3 nominal steps after their samples, which are up to half a step late; so late is one channel."""
    random = np.random.default_rng(2)
    t = np.append(0.0, np.arange(1, 80) + random.uniform(0, 0.5, 79)) / 100.0
    planned = random.choice([-6.0, 6.0], (80, 1))
    delay = 1.3
    dt = 1e-4
    law = Controller(jnp.asarray(0), lambda number, t, x: (number + 1, jnp.asarray(planned)[number]))
    arrived = np.searchsorted(t + delay / 100.0, dt * np.arange(8100) + dt / 2) - 1
    held = np.where(arrived[:, None] >= 0, planned[arrived], 0.0)
    step = integrated(FIELD, dt)
    start = belief([0.0, 1.0, 0.0, 0.0], 1e-4)
    fine = jax.jit(lambda u: jax.lax.scan(lambda x, u: (step(x, u), x), start.x, u)[1])(held)
    x = np.asarray(fine)[np.round(t / dt).astype(int)]
    sharp = PROCESS._replace(noise=np.array([1e-5, 1e-5]), disturbance=np.array([0.2, 0.01]))
    for late in (0, 2):
        y = x[:, :2].copy()
        y[late:, 1] = y[: len(y) - late, 1]
        estimates = replay(estimating(law, sharp, start, delay=delay, late=(0, late)))
        known, ignored = (np.abs(estimates(y, times)[0] - x)[:, 2:].max(axis=0) for times in (t, None))
        assert (known < 0.25 * ignored).all()


def test_wrong_numbers_of_samples_are_refused():
    for settings, message in (
        ({"late": (1, -1)}, "late is"),
        ({"delay": -0.5}, r"delay is -0\.5; expected a number of samples"),
        ({"every": 0}, "every is 0"),
    ):
        with one_line(message):
            estimating(ASKED, **settings)


@pytest.mark.slow
def test_a_controller_with_an_unscented_filter_and_late_measurements_is_the_same_in_c(tmp_path):
    settings = {"controls": 1, "delay": 1, "late": (0, 1), "every": (1, 2), "rate": 100.0}
    controller = with_estimate(ASKED, PROCESS._replace(unscented=True), PRIOR, **settings)
    leaves, tree = jax.tree.flatten(controller.start)

    def act(t, y, *memory):
        memory, u = controller.act(jax.tree.unflatten(tree, memory), t, y)
        return {"u": u, **{f"after_{number}": leaf for number, leaf in enumerate(jax.tree.leaves(memory))}}

    memory = memory_in_c = [np.asarray(leaf) for leaf in leaves]
    export_c({"act": (act, (np.zeros(()), np.zeros(2), *memory))}, tmp_path, finite=True, loop_bound=30)
    assert stated_costs(tmp_path)["act"].unbounded_loops == 0
    in_c, in_jax = load_c(tmp_path, flags=("-O1",)).act, jax.jit(act)
    for number, y in enumerate(np.asarray(measurements(12))):
        t = np.asarray(0.01 * number + 0.002 * (number % 3))
        expected, got = in_jax(t, y, *memory), in_c(t, y, *memory_in_c)._asdict()
        assert_allclose(got["u"], expected["u"], rtol=1e-9, atol=1e-12)
        memory, memory_in_c = (
            [np.asarray(answer[f"after_{number}"]) for number in range(len(leaves))] for answer in (expected, got)
        )
