"""A rotary pendulum in another process, with noise and late controls, is explored and identified through its loop."""

import multiprocessing
from collections import deque

import numpy as np
import pytest

from dln_jax.control.plants import Exploration, explore, hardware_plant, layout
from dln_jax.learning.recordings import identified_chain, prepare

RATE, STEP, DELAY = 100.0, 1e-3, 2
NOISE = 2 * np.pi / 4096 / np.sqrt(12)  # that of an encoder's resolution
INERTIA, COUPLING, PENDULUM, WEIGHT = 2.6e-4, 1.3e-4, 1.33e-4, 1.52e-2
LAYOUT = layout(
    ("revolute", "revolute"), [0], goal=(0, 0), hanging=(0, np.pi), rate=RATE, control=0.05,
    position=[[-2.5, 2.5], [-np.inf, np.inf]],
)  # fmt: skip


def rates(x, u):
    """The pendulum's weight pulls it to pi; the arm has damping."""
    M = np.array([[INERTIA, COUPLING * np.cos(x[1])], [COUPLING * np.cos(x[1]), PENDULUM]])
    forces = [u + COUPLING * np.sin(x[1]) * x[3] ** 2 - 2e-4 * x[2], WEIGHT * np.sin(x[1]) - 1e-5 * x[3]]
    return np.concatenate([x[2:], np.linalg.solve(M, forces)])


def serve(pipe):
    """The other process: its clock is its own, and it wakes late by up to a tenth of a sample."""
    random, x, t, u = np.random.default_rng(0), np.zeros(4), 0.0, 0.0
    late = deque([0.0] * round(DELAY / RATE / STEP))
    while True:
        what, value = pipe.recv()
        if what == "write":
            u = float(value[0])
        if what == "sleep":
            for _ in range(max(1, round((value + 0.1 / RATE * random.uniform()) / STEP))):
                late.append(u)
                k = rates(x, now := late.popleft())
                x, t = x + STEP * rates(x + STEP / 2 * k, now), t + STEP
        if what == "reset":
            x = np.array([0.0, np.pi + 0.1 * random.normal(), 0.0, 0.0])
        pipe.send({"read": x[:2] + NOISE * random.normal(size=2), "time": t}.get(what))


@pytest.mark.slow
def test_a_plant_in_another_process_is_learned_through_its_loop():
    context = multiprocessing.get_context("spawn")  # a fork of a process that runs JAX can hang
    ours, theirs = context.Pipe()
    process = context.Process(target=serve, args=(theirs,), daemon=True)
    process.start()

    def ask(what, value=None):
        ours.send((what, value))
        return ours.recv()

    plant = hardware_plant(
        LAYOUT, reset=lambda: ask("reset"), read=lambda: ask("read"), write=lambda u: ask("write", np.array(u)),
        clock=lambda: ask("time"), sleep=lambda seconds: ask("sleep", seconds),
    )  # fmt: skip
    try:
        blind = Exploration(blind=(0.3, 0.4, 0.5, 0.6), surplus=())
        explored = explore(plant, lambda _: pytest.fail("no model is needed"), blind)
    finally:
        process.terminate()
        process.join()
    assert not explored.stopped
    prepared = prepare(explored.recording, chain=True)
    assert prepared.delay == DELAY
    model = identified_chain(prepared, LAYOUT.needs).dynamics
    M = np.asarray(model.mass_matrix(LAYOUT.hanging))  # blind episodes swing about it, and show nothing of the goal
    np.testing.assert_allclose(M, [[INERTIA, -COUPLING], [-COUPLING, PENDULUM]], rtol=0.05)
