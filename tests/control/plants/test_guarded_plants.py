"""A plant stops at its limits and at wrong answers, with zero controls and a reason."""

import gc

import numpy as np
import pytest
from calls import one_line
from numpy.testing import assert_allclose, assert_array_equal

from dln_jax.control.closed_loop import Controller, Push
from dln_jax.control.plants.outside_loops import hardware_plant
from dln_jax.control.plants.plant import Plant, layout
from dln_jax.control.plants.runs import PlantRun, Stopped, compiled, guarded, judged_runs, run, start_of


def described(actuated=(0,), **changed):
    keywords = {"goal": (0, np.pi), "hanging": (0, 0), "rate": 100.0, "control": 2.0, "names": ("rail", "hinge")}
    rail = [[-0.5, 0.5], [-np.inf, np.inf]]
    return layout(("prismatic", "revolute"), list(actuated), **{**keywords, "position": rail, **changed})


class Puppet:
    """A plant that goes where the test says."""

    def __init__(self, **changed):
        self.q = np.zeros(2)
        self.t = 0.0
        self.commands = []
        self.layout = described(**changed)

    def act(self, u):
        self.commands.append(np.asarray(u))
        self.t += 0.01

    def bare(self):
        return Plant(self.layout, lambda: None, lambda: self.q, self.act, lambda: self.t)

    def guarded(self):
        safe = guarded(self.bare())
        safe.reset()
        return safe


def test_starts_outside_the_limits_or_far_from_hanging_are_refused():
    puppet = Puppet()
    for q, message in (
        ([0.1, 3.0], "'hinge' starts 3 rad from hanging; expected at most 1"),
        ([0.7, 0.0], r"'rail' is at 0\.7.*the start is outside"),
        ([0.0, 0.0, 0.0], "expected 2 coordinates"),
    ):
        puppet.q = np.array(q)
        with one_line(message):
            puppet.guarded()
    puppet.q = np.array([0.1, 2 * np.pi - 0.9])  # is -0.9
    puppet.guarded()
    assert not puppet.commands


def test_wrong_answer_stops_the_plant_with_zero_controls_until_it_is_reset():
    for q, t, late, reason in (
        ([0.6, 0.0], 0.01, 2, "'rail' is at 0.6, outside -0.5 to 0.5"),
        ([0.1, np.nan], 0.01, 2, "not finite"),
        ([0.0, 0.0], 0.021, 2, "an answer is 21 ms after the last, more than 2 samples"),
        ([0.0, 0.0], 0.041, 4, "an answer is 41 ms after the last, more than 4 samples"),
        ([0.0, 0.0], np.nan, 2, "not finite"),
        ([0.0, 0.0], 0.0, 2, "expected it to advance with every sample"),
    ):
        puppet = Puppet(late=late)
        safe = puppet.guarded()
        safe.act([1.0])
        puppet.q, puppet.t = np.array(q), t
        for again in (safe.read, lambda safe=safe: safe.act([1.0])):
            with pytest.raises(Stopped, match=reason):
                again()
        assert_array_equal(np.ravel(puppet.commands), [1.0, 0.0])
        puppet.q, puppet.t = np.zeros(2), 0.0
        safe.reset()
        safe.act([1.0])
        assert len(puppet.commands) == 3
        puppet.t = 0.01 * late - 1e-3
        safe.read()


def test_rate_and_distance_to_stop_count_as_limits():
    for changed, reason in (({"speed": 1.0}, "faster than 1/s"), ({"stopping": 0.3}, "towards its limits")):
        puppet = Puppet(**changed)
        safe = puppet.guarded()
        with pytest.raises(Stopped, match=reason):
            for _ in range(30):  # 2 m/s, half a metre to the end of the rail
                puppet.q = puppet.q + np.array([0.02, 0.0])
                puppet.t += 0.01
                safe.read()
        assert puppet.q[0] < 0.1


def test_controls_beyond_the_motor_stop_the_plant():
    for u, reason in (([2.1], "outside"), ([np.nan], "expected 1 finite")):
        puppet = Puppet()
        with pytest.raises(Stopped, match=reason):
            puppet.guarded().act(u)
        assert_array_equal(puppet.commands, [[0.0]])


def test_wrapped_angles_become_continuous():
    puppet = Puppet(hanging=(0, np.pi))
    puppet.q = np.array([0.0, -3.0])
    safe = puppet.guarded()
    for angle in np.arange(3.2, 12.0, 0.5):
        puppet.q = np.array([0.0, np.remainder(angle + np.pi, 2 * np.pi) - np.pi])
        puppet.t += 0.01
        assert safe.read()[1] == pytest.approx(angle)


def test_layouts_that_contradict_themselves_are_refused():
    for changed, message in (
        ({"goal": (1.0, np.pi)}, "goal is .* outside the limits"),
        ({"goal": (0.0, 0.0, np.pi)}, "goal is"),
        ({"goal": (0.5, np.pi), "position": [[-0.5, 0.5], [-4, 4]]}, "the goal of 'rail', 0.5, is at the end"),
        ({"position": [[-0.5, 0.5], [-np.pi, np.pi]]}, "the goal of 'hinge', 3.142, is at the end of its range"),
        ({"control": np.inf}, "finite, positive limits"),
        ({"rate": 0.0}, "rate is 0"),
        ({"position": [[0.5, -0.5], [-1, 1]]}, "position is"),
        ({"speed": -1.0}, "speed is"),
        ({"late": 1.0}, "late is 1.*expected more than 1"),
        ({"actuated": []}, "no joint has a motor"),
        ({"actuated": [0, 1]}, "all 2 joints have a motor"),
        ({"actuated": [2]}, "from 0 to 1"),
    ):
        with one_line(message):
            described(**changed)


def test_hardware_waits_for_the_next_sample_and_does_not_catch_up():
    now = [0.0]
    slept = []

    def sleep(seconds):
        slept.append(seconds)
        now[0] += seconds

    def write(u):
        now[0] += 0.004

    plant = hardware_plant(
        described(), reset=lambda: None, read=lambda: np.zeros(2), write=write, clock=lambda: now[0], sleep=sleep
    )
    plant.reset()
    plant.act([0.0])
    assert now[0] == pytest.approx(0.01) and slept == [pytest.approx(0.006)]
    now[0] += 0.05
    plant.act([0.0])  # late: acts at once
    assert len(slept) == 1
    plant.act([0.0])
    assert slept[-1] == pytest.approx(0.006)


def test_run_is_up_if_it_is_near_the_goal_for_the_last_second_without_a_stop():
    t = np.arange(500) / 100
    y = np.stack([np.zeros(500), np.where(t < 2, 0.0, 3 * np.pi)], axis=1)
    late = np.where(t[:, None] < 4.5, 0.0, y)
    runs = [PlantRun(t, y, t), PlantRun(t, y, t, "rail"), PlantRun(t, late, t), PlantRun(t, np.nan * y, t)]
    trials = judged_runs(runs, described(), seconds=5.0)
    assert_array_equal(trials.up, [True, False, False, False])
    assert trials.seconds[0] == pytest.approx(2.0) and trials.stopped == ("rail",)


def test_push_reaches_the_plant_at_its_sample():
    puppet = Puppet()
    kicks = []
    still = Controller(np.zeros(()), lambda memory, t, y: (memory, np.zeros(1)))
    kicked = puppet.bare()._replace(kick=lambda rates: kicks.append((puppet.t, rates)))
    settings = {"seconds": 0.1, "push": Push(0.05, [0.0, 3.0])}
    act = compiled(still, puppet.layout)
    run([kicked], act, start_of(still, 1), **settings)
    ((t, rates),) = kicks
    assert t == pytest.approx(0.05)
    assert_array_equal(rates, [0.0, 3.0])
    with one_line("no kick"):
        run([puppet.bare()], act, start_of(still, 1), **settings)


def test_compilation_does_not_count_as_a_late_answer():
    puppet = Puppet()
    calls = []

    def act(memory, t, y):
        calls.append(t)
        puppet.t += 1.0 if len(calls) <= 2 else 0.0  # compilation for the first memory, and for later ones
        return memory, np.zeros((1, 1))

    (result,) = run([puppet.bare()], act, np.zeros(1), seconds=0.1)
    assert not result.stopped and len(result.t) == 10


def test_an_interrupt_leaves_the_motors_at_zero():
    puppet = Puppet()

    def act(memory, t, y):
        if len(puppet.commands) == 3:
            raise KeyboardInterrupt
        return memory, np.ones((1, 1))

    with pytest.raises(KeyboardInterrupt):
        run([puppet.bare()], act, np.zeros(1), seconds=1.0)
    assert_array_equal(np.ravel(puppet.commands), [1.0, 1.0, 1.0, 0.0])


def test_run_states_the_times_of_the_answers_and_restores_garbage_collection():
    puppet = Puppet()
    late = np.array([0.0, 2e-3, 0.0, 5e-3, 1e-3])
    puppet.t = 7.0

    def act(u):
        puppet.commands.append(u)
        number = len(puppet.commands)
        puppet.t = 7.0 + 0.01 * number + late[number % len(late)]

    zero = lambda memory, t, y: (memory, np.zeros((1, 1)))  # noqa: E731
    (result,) = run([puppet.bare()._replace(act=act)], zero, np.zeros(1), seconds=0.05)
    assert_allclose(result.t, 0.01 * np.arange(5) + late, atol=1e-12)
    assert gc.get_freeze_count() == 0
