"""Controllers with a filter use late measurements at their own time, and act on the state of the moment of action."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dln_jax
from dln_jax.control import Hardware, simulate, stateless
from dln_jax.control.closed_loop import Controller
from dln_jax.control.desktop_plants import desktop_rotary_pendulum, model_of_plant, try_starts
from dln_jax.control.estimate import belief, extended, filtered, mechanical, with_estimate
from dln_jax.control.plants.estimators import by_filter
from dln_jax.control.state_space import integrated
from dln_jax.export.c.load import load_c
from dln_jax.export.c.source import export_c
from dln_jax.scenes import cart_pole
from dln_jax.types import InputError

SCENE = cart_pole()
MODEL, B = dln_jax.dynamics(SCENE.closed_form), np.array(SCENE.needs.actuation)
PROCESS = mechanical(MODEL, B, rate=100.0, band=[0.2, 0.01], encoder_noise=[1e-3, 2e-3])
PRIOR = belief([0.0, np.pi, 0.0, 0.0], [0.01, 0.05, 0.05, 0.1])
ASKED = stateless(lambda x: jnp.array([1.0]) * jnp.sin(3 * x[0] + x[2] + 1.0))


def replayed(controller, y):
    """Estimates and controls of a controller along measurements."""

    def sample(memory, row):
        number, y = row
        memory, u = controller.act(memory, number / 100.0, y)
        return memory, (memory.x, u)

    return jax.jit(lambda: jax.lax.scan(sample, controller.start, (jnp.arange(len(y)), y))[1])()


def measurements(samples=60):
    random = np.random.default_rng(0)
    slow = np.cumsum(np.cumsum(random.normal(size=(samples, 2)), axis=0), axis=0) * [2e-4, 4e-4]
    return jnp.asarray(slow + np.array([0.0, np.pi]))


def test_late_measurements_give_the_estimates_that_prompt_ones_gave_so_many_samples_before():
    y = measurements()
    # A law that does not depend on the state has the same controls in both loops.
    idle = stateless(lambda x: 0.0 * x[:1])
    prompt = with_estimate(idle, extended(PROCESS), PRIOR, controls=1, measurements=2)
    late = with_estimate(idle, extended(PROCESS), PRIOR, controls=1, measurements=2, late=(1, 3))
    at_once, _ = replayed(prompt, y)
    shifted = jnp.stack([jnp.roll(y[:, 0], 1), jnp.roll(y[:, 1], 3)], axis=1)
    delayed, _ = replayed(late, shifted)
    # At sample k the late loop knows channel 0 up to k - 1 and channel 1 up to k - 3: filter that log directly.
    seen = np.ones((len(y), 2), bool)
    for k in (10, 40):
        seen[k], seen[k - 2 : k] = False, [True, False]
        direct, _ = jax.jit(lambda s: filtered(extended(PROCESS), PRIOR, y, jnp.zeros((len(y), 1)), s))(seen)
        np.testing.assert_allclose(delayed[k], direct[k], rtol=0, atol=1e-12)
        seen[k - 2 : k + 1] = True
    assert np.abs(delayed - at_once).max() > 1e-4


def test_channels_of_several_rates_are_used_when_they_are_new():
    y = measurements()
    idle = stateless(lambda x: 0.0 * x[:1])
    slow = with_estimate(idle, extended(PROCESS), PRIOR, controls=1, measurements=2, every=(1, 4))
    seen = np.stack([np.ones(len(y), bool), np.arange(len(y)) % 4 == 0], axis=1)
    direct, _ = jax.jit(lambda: filtered(extended(PROCESS), PRIOR, y, jnp.zeros((len(y), 1)), seen))()
    np.testing.assert_allclose(replayed(slow, y)[0], direct, rtol=0, atol=1e-12)


@pytest.mark.parametrize("delay", [0, 2])
def test_a_law_behind_a_delay_acts_on_the_state_in_which_its_control_takes_effect(delay):
    # With exact measurements and an exact model the delayed loop repeats the prompt one from its first control on.
    sharp = PROCESS._replace(noise=np.array([1e-7, 1e-7]), disturbance=np.array([1e-6, 1e-6]))
    exact = belief([0.0, np.pi, 0.0, 0.0], 1e-6)
    hardware = Hardware(delay=delay, sees_rates=False)
    controller = with_estimate(ASKED, extended(sharp), exact, controls=1, measurements=2, delay=delay)

    def field(x, u):
        return jnp.concatenate([x[2:], MODEL.forward_dynamics(x[:2], x[2:], B @ u)])

    run = jax.jit(
        lambda: simulate(field, controller, exact.x, seconds=0.5, rate=100.0, controls=1, hardware=hardware)
    )()
    asked = jax.vmap(lambda x: ASKED.act((), jnp.zeros(()), x)[1])(run.x[:-1])
    np.testing.assert_allclose(run.u[delay:], asked[delay:], rtol=0, atol=1e-5)


def test_a_law_behind_half_a_sample_acts_on_the_state_half_a_sample_later():
    sharp = PROCESS._replace(noise=np.array([1e-7, 1e-7]), disturbance=np.array([1e-6, 1e-6]))
    exact = belief([0.0, np.pi, 0.0, 0.0], 1e-6)
    controller = with_estimate(ASKED, extended(sharp), exact, controls=1, measurements=2, delay=0.5)

    def field(x, u):
        return jnp.concatenate([x[2:], MODEL.forward_dynamics(x[:2], x[2:], B @ u)])

    half = jax.jit(integrated(field, 0.005))
    act = jax.jit(controller.act)
    memory, x, u = controller.start, np.asarray(exact.x), np.zeros(1)
    errors = []
    for number in range(50):
        memory, asked = act(memory, number / 100.0, x[:2])
        x = half(x, u)  # the control of the sample before still acts
        errors.append(asked[0] - ASKED.act((), jnp.zeros(()), x)[1][0])
        x, u = half(x, asked), asked
    # The plant knows when the control changes; the filter knows the mean over the sample.
    assert np.abs(errors).max() < 2e-3


@pytest.fixture(scope="module")
def uneven_swing():
    """Times that are up to half a step late, and states of a free swing at these times, exact."""
    t = (np.arange(150) + np.random.default_rng(1).uniform(0, 0.5, 150)) / 100.0
    idle = jnp.zeros(1)

    def field(x, u):
        return jnp.concatenate([x[2:], MODEL.forward_dynamics(x[:2], x[2:], B @ u)])

    step = integrated(field, 1e-3)
    x = jax.jit(
        lambda: jax.lax.scan(lambda x, _: (step(x, idle), x), jnp.array([0.0, 1.0, 0.0, 0.0]), jnp.arange(1600))[1]
    )()
    number = np.round(t * 1000).astype(int)
    return number / 1000.0, np.asarray(x)[number]


@pytest.mark.parametrize("late", [0, (0, 2)])
def test_filters_use_the_times_of_samples(uneven_swing, late):
    t, x = uneven_swing
    y = x[:, :2].copy()
    if late:
        y[2:, 1] = y[:-2, 1]
    settings = {"controls": 1, "measurements": 2, "late": late}
    start = belief([0.0, 1.0, 0.0, 0.0], [1e-3, 1e-3, 0.1, 0.1])

    def worst(t, **more):
        controller = with_estimate(lambda x: 0.0 * x[:1], extended(PROCESS), start, **settings, **more)

        def sample(memory, row):
            memory, _ = controller.act(memory, *row)
            return memory, memory.x

        estimates = jax.jit(lambda: jax.lax.scan(sample, controller.start, (jnp.asarray(t), jnp.asarray(y)))[1])()
        return np.abs(estimates - x)[20:, 2:].max(), estimates

    nominal, known = np.arange(len(t)) / 100.0, worst(t, rate=100.0)[0]
    ignored, estimates = worst(t)
    assert known < 0.2 * ignored
    np.testing.assert_allclose(worst(nominal, rate=100.0)[1], estimates, rtol=0, atol=1e-9)


@pytest.mark.parametrize("delay", [0, 1.3])
def test_controls_act_when_they_arrive_though_samples_are_late(delay):
    """The plant takes every control 1.3 nominal steps after its sample; samples are up to half a step late."""
    t = (np.arange(80) + np.random.default_rng(2).uniform(0, 0.5, 80)) / 100.0
    t[0] = 0.0
    planned = jnp.asarray(np.random.default_rng(3).choice([-6.0, 6.0], (80, 1)))
    law = Controller(jnp.asarray(0), lambda number, t, x: (number + 1, planned[number]))

    def field(x, u):
        return jnp.concatenate([x[2:], MODEL.forward_dynamics(x[:2], x[2:], B @ u)])

    moments = 1e-4 * np.arange(8100)
    arrived = np.searchsorted(t + delay / 100.0, moments + 5e-5) - 1
    held = np.where(arrived[:, None] >= 0, np.asarray(planned)[arrived], 0.0)
    fine, start = integrated(field, 1e-4), jnp.array([0.0, 1.0, 0.0, 0.0])
    run = jax.jit(lambda: jax.lax.scan(lambda x, u: (fine(x, u), x), start, jnp.asarray(held))[1])()
    x = np.asarray(run)[np.round(t * 1e4).astype(int)]
    sharp = PROCESS._replace(noise=np.array([1e-5, 1e-5]), disturbance=np.array([0.2, 0.01]))

    def worst(**more):
        controller = with_estimate(
            law, extended(sharp), belief(start, 1e-4), controls=1, measurements=2, delay=delay, **more
        )

        def sample(memory, row):
            memory, _ = controller.act(memory, *row)
            return memory, memory.x

        rows = jnp.asarray(t), jnp.asarray(x[:, :2])
        estimates = jax.jit(lambda: jax.lax.scan(sample, controller.start, rows)[1])()
        return np.abs(estimates - x)[:, 2:].max(axis=0)

    known, ignored = worst(rate=100.0), worst()
    assert (known < 0.25 * ignored).all()


def test_a_failed_measurement_is_not_hidden():
    controller = with_estimate(ASKED, extended(PROCESS), PRIOR, controls=1, measurements=2)
    _, u = replayed(controller, measurements(6).at[3, 1].set(jnp.nan))
    assert np.isfinite(u[:3]).all() and np.isnan(u[3:]).all()


def test_wrong_numbers_of_samples_are_refused():
    with pytest.raises(InputError, match="late is"):
        with_estimate(ASKED, extended(PROCESS), PRIOR, controls=1, measurements=2, late=(1, -1))
    with pytest.raises(InputError, match=r"delay is -0\.5; expected a number of samples"):
        with_estimate(ASKED, extended(PROCESS), PRIOR, controls=1, measurements=2, delay=-0.5)
    with pytest.raises(InputError, match="every is 0"):
        with_estimate(ASKED, extended(PROCESS), PRIOR, controls=1, measurements=2, every=0)


@pytest.mark.slow
def test_swing_ups_with_a_filter_succeed_and_hold_with_less_torque():
    plant = desktop_rotary_pendulum()
    model = model_of_plant(plant)
    # The plant's own noise: that of its control and of its encoders.
    process = mechanical(
        model, plant.scene.needs.actuation, rate=plant.rate, band=[2.5e-4, 1e-5],
        encoder_step=plant.hardware.encoder_step,
    )  # fmt: skip
    different, filtering = (
        try_starts(plant, model, starts=6, seconds=4.0, estimator=estimator)
        for estimator in (None, by_filter(plant.layout, process, delay=1))
    )
    assert different.outcomes.share == filtering.outcomes.share == 1
    assert np.median(filtering.effort) < 0.3 * np.median(different.effort)


@pytest.mark.slow
def test_a_controller_with_a_filter_and_late_measurements_is_the_same_in_c(tmp_path):
    controller = with_estimate(
        ASKED, extended(PROCESS), PRIOR, controls=1, measurements=2, delay=1, late=(0, 1), every=(1, 2), rate=100.0
    )
    leaves, tree = jax.tree.flatten(controller.start)

    def act(t, y, *memory):
        memory, u = controller.act(jax.tree.unflatten(tree, memory), t, y)
        return {"u": u, **{f"after_{number}": leaf for number, leaf in enumerate(jax.tree.leaves(memory))}}

    export_c({"act": (act, (np.zeros(()), np.zeros(2), *map(np.asarray, leaves)))}, tmp_path / "loop")
    in_c, in_jax = load_c(tmp_path / "loop", flags=("-O1",)), jax.jit(act)
    memory = memory_in_c = [np.asarray(leaf) for leaf in leaves]
    for number, y in enumerate(np.asarray(measurements(12))):
        t = np.asarray(0.01 * number + 0.002 * (number % 3))
        expected, got = in_jax(t, y, *memory), in_c.act(t, y, *memory_in_c)
        np.testing.assert_allclose(got.u, expected["u"], rtol=1e-9, atol=1e-12)
        memory = [np.asarray(expected[f"after_{number}"]) for number in range(len(leaves))]
        memory_in_c = [np.asarray(getattr(got, f"after_{number}")) for number in range(len(leaves))]
