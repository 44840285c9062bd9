"""A user's own loop in another process, with a clock that jitters and answers that come late, runs and stops safely."""

import multiprocessing
from contextlib import contextmanager

import numpy as np
import pytest

from dln_jax.control.closed_loop import stateless
from dln_jax.control.plants import compiled, hardware_plant, layout, run, start_of
from dln_jax.control.plants.estimators import by_differences

RATE, STEP = 100.0, 1e-3
LAYOUT = layout(
    ("revolute", "revolute"), [0], goal=(0, np.pi), hanging=(0, 0), rate=RATE, control=1.0, names=("a", "p")
)


def serve(pipe, late_at):
    """The other process: an arm with inertia 0.1 kg m² and damping, and a pole that follows; its clock is its own."""
    random, state, t, u, commands = np.random.default_rng(0), np.zeros(2), 0.0, 0.0, []
    while True:
        what, value = pipe.recv()
        if what == "end":
            pipe.send(commands)
            return
        if what == "write":
            u = float(value[0])
            commands.append(u)
        if what == "sleep":
            # The system wakes late by up to a fifth of a sample, and once by five samples.
            asked = max(value, STEP) + 0.2 / RATE * random.uniform()
            if late_at is not None and len(commands) == late_at:
                asked += 5 / RATE
            for _ in range(round(asked / STEP)):
                state = state + STEP * np.array([state[1], (u - 0.05 * state[1]) / 0.1])
                t += STEP
        if what == "reset":
            state[:] = 0.3, 0.0
        pipe.send({"read": [state[0], 0.1 * state[0]], "time": t}.get(what))


@contextmanager
def hardware(late_at=None):
    """The plant, and the commands that it got until the end."""
    # A fork of a process that runs JAX can hang.
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=serve, args=(theirs, late_at), daemon=True)
    process.start()

    def ask(what, value=None):
        ours.send((what, value))
        return ours.recv()

    commands = []
    try:
        yield (
            hardware_plant(
                LAYOUT, reset=lambda: ask("reset"), read=lambda: ask("read"), write=lambda u: ask("write", np.array(u)),
                clock=lambda: ask("time"), sleep=lambda seconds: ask("sleep", seconds),
            ),
            commands,
        )  # fmt: skip
        commands.extend(ask("end"))
    finally:
        process.terminate()
        process.join()


CONTROLLER = by_differences(LAYOUT)(stateless(lambda x: -2 * x[:1] - 0.5 * x[2:3]))


def loop(plant):
    (result,) = run([plant], compiled(CONTROLLER, LAYOUT), start_of(CONTROLLER, 1), seconds=3.0)
    return result


@pytest.mark.slow
def test_a_clock_that_jitters_within_a_sample_does_not_stop_the_loop():
    with hardware() as (plant, commands):
        result = loop(plant)
    assert not result.stopped and len(result.t) == 300
    assert abs(result.y[-1, 0]) < 1e-3 < abs(result.y[0, 0])
    np.testing.assert_allclose(commands[:-1], result.u[:, 0], atol=1e-12)
    assert commands[-1] == 0


@pytest.mark.slow
def test_an_answer_that_is_late_by_five_samples_stops_the_motor():
    with hardware(late_at=50) as (plant, commands):
        result = loop(plant)
    assert "more than 2 samples" in result.stopped and len(result.t) == 50
    assert commands[-1] == 0 and len(commands) == 51
