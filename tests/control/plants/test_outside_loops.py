"""A user's own loop, with a clock that jitters, late answers and late controls, stops safely and is identified."""

from collections import deque

import numpy as np
import pytest

from dln_jax.control.closed_loop import stateless
from dln_jax.control.plants import Exploration, compiled, explore, hardware_plant, layout, run, start_of
from dln_jax.control.plants.estimators import by_differences
from dln_jax.learning.recordings import identified_chain, prepare

RATE, STEP, DELAY = 100.0, 1e-3, 2
NOISE = 2 * np.pi / 4096 / np.sqrt(12)  # that of an encoder's resolution
INERTIA, COUPLING, PENDULUM, WEIGHT = 2.6e-4, 1.3e-4, 1.33e-4, 1.52e-2
LAYOUT = layout(
    ("revolute", "revolute"),
    [0],
    goal=(0, 0),
    hanging=(0, np.pi),
    rate=RATE,
    control=0.05,
    position=[[-2.5, 2.5], [-np.inf, np.inf]],
)


def rates(x, u):
    """The pendulum's weight pulls it to pi; the arm has damping."""
    M = np.array([[INERTIA, COUPLING * np.cos(x[1])], [COUPLING * np.cos(x[1]), PENDULUM]])
    forces = [u + COUPLING * np.sin(x[1]) * x[3] ** 2 - 2e-4 * x[2], WEIGHT * np.sin(x[1]) - 1e-5 * x[3]]
    return np.concatenate([x[2:], np.linalg.solve(M, forces)])


class Loop:
    """A rotary pendulum with noise and late controls, whose clock is its own and wakes late, once by five samples."""

    def __init__(self, late_at=None):
        self.random, self.late_at = np.random.default_rng(0), late_at
        self.x, self.t, self.commands = np.zeros(4), 0.0, [0.0]
        self.queue = deque([0.0] * round(DELAY / RATE / STEP))

    def reset(self):
        self.x = np.array([0.0, np.pi + 0.1 * self.random.normal(), 0.0, 0.0])

    def read(self):
        return self.x[:2] + NOISE * self.random.normal(size=2)

    def write(self, u):
        self.commands.append(float(u[0]))

    def sleep(self, seconds):
        seconds += 0.1 / RATE * self.random.uniform()
        if len(self.commands) == self.late_at:
            seconds += 5 / RATE
        for _ in range(max(1, round(seconds / STEP))):
            self.queue.append(self.commands[-1])
            now = self.queue.popleft()
            k = rates(self.x, now)
            self.x = self.x + STEP * rates(self.x + STEP / 2 * k, now)
            self.t += STEP

    def plant(self):
        return hardware_plant(
            LAYOUT, reset=self.reset, read=self.read, write=self.write, clock=lambda: self.t, sleep=self.sleep
        )


def test_jitter_within_a_sample_is_no_stop_and_five_late_samples_are():
    controller = by_differences(LAYOUT)(stateless(lambda x: -0.01 * x[:1] - 1e-3 * x[2:3]))
    act = compiled(controller, LAYOUT)
    for late_at, samples in ((None, 100), (50, 49)):
        loop = Loop(late_at)
        (result,) = run([loop.plant()], act, start_of(controller, 1), seconds=1.0)
        assert len(result.t) == samples and ("more than 2 samples" in result.stopped) == bool(late_at)
        np.testing.assert_allclose(loop.commands[1:], [*result.u[:samples, 0], 0.0], atol=1e-12)


@pytest.mark.slow
def test_plant_is_identified_through_its_loop():
    blind = Exploration(blind=(0.3, 0.4, 0.5, 0.6), surplus=())
    explored = explore(Loop().plant(), lambda _: pytest.fail("no model is needed"), blind)
    assert not explored.stopped
    prepared = prepare(explored.recording, chain=True)
    assert prepared.delay == DELAY
    model = identified_chain(prepared, LAYOUT.needs).dynamics
    M = np.asarray(model.mass_matrix(LAYOUT.hanging))  # blind episodes swing about it, and show nothing of the goal
    np.testing.assert_allclose(M, [[INERTIA, -COUPLING], [-COUPLING, PENDULUM]], rtol=0.05)
