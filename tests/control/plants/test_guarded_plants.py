"""A plant stops at its limits and at wrong answers, with zero controls and a reason."""

import gc

import numpy as np
import pytest

from dln_jax.control import Controller, Push
from dln_jax.control.plants import Plant, Stopped, guarded, hardware_plant, layout
from dln_jax.control.plants.runs import PlantRun, compiled, judged_runs, run, start_of
from dln_jax.types import InputError

HALF_PI = np.pi / 2


def described(**changed):
    keywords = {"goal": (0, np.pi), "hanging": (0, 0), "rate": 100.0, "control": 2.0, "names": ("rail", "hinge")}
    rail = [[-0.5, 0.5], [-np.inf, np.inf]]
    return layout(("prismatic", "revolute"), [0], **{**keywords, "position": rail, **changed})


class Puppet:
    """A plant that goes where the test says."""

    def __init__(self, **changed):
        self.q, self.t, self.commands, self.layout = np.zeros(2), 0.0, [], described(**changed)

    def act(self, u):
        self.commands.append(np.asarray(u))
        self.t += 0.01

    def plant(self):
        return guarded(Plant(self.layout, lambda: None, lambda: self.q, self.act, lambda: self.t))


def test_a_start_far_from_hanging_is_refused():
    puppet = Puppet()
    puppet.q = np.array([0.1, 3.0])
    with pytest.raises(InputError, match="'hinge' starts 3 rad from hanging; expected at most 1"):
        puppet.plant().reset()
    puppet.q = np.array([0.1, 2 * np.pi - 0.9])  # is -0.9
    puppet.plant().reset()
    assert not puppet.commands


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"q": np.array([0.6, 0.0])}, "'rail' is at 0.6, outside -0.5 to 0.5"),
        ({"q": np.array([0.1, np.nan])}, "not finite"),
        ({"t": 0.031}, "an answer is 31 ms after the last"),
        ({"t": np.nan}, "not finite"),
        ({"t": 0.0}, "expected it to advance with every sample"),
    ],
    ids=["rail", "nan", "late", "clock", "standstill"],
)
def test_a_wrong_answer_stops_the_plant_with_zero_controls(change, reason):
    puppet = Puppet()
    safe = puppet.plant()
    safe.reset()
    safe.act([1.0])
    for name, value in change.items():
        setattr(puppet, name, value)
    with pytest.raises(Stopped, match=reason):
        safe.read()
    np.testing.assert_array_equal(puppet.commands[-1], [0.0])
    # It stays stopped, whatever comes next, until it is reset.
    with pytest.raises(Stopped, match=reason):
        safe.act([1.0])
    assert len(puppet.commands) == 2
    puppet.q, puppet.t = np.zeros(2), 0.0
    safe.reset()
    safe.act([1.0])
    assert len(puppet.commands) == 3


def test_the_rate_and_the_way_to_stop_count_as_limits():
    for changed, reason in (({"speed": 1.0}, "faster than 1/s"), ({"stopping": 0.3}, "towards its limits")):
        puppet = Puppet(**changed)
        safe = puppet.plant()
        safe.reset()
        with pytest.raises(Stopped, match=reason):
            for _ in range(30):  # 2 m/s, half a metre to the end of the rail
                puppet.q = puppet.q + np.array([0.02, 0.0])
                puppet.t += 0.01
                safe.read()
        assert puppet.q[0] < 0.1


def test_a_layout_states_how_late_an_answer_may_be():
    puppet = Puppet(late=4.0)
    safe = puppet.plant()
    safe.reset()
    puppet.t = 0.039
    safe.read()
    puppet.t += 0.041
    with pytest.raises(Stopped, match="41 ms after the last, more than 4 samples"):
        safe.read()


def test_controls_beyond_the_motor_stop_the_plant():
    for u, reason in (([2.1], "outside"), ([np.nan], "expected 1 finite")):
        puppet = Puppet()
        safe = puppet.plant()
        safe.reset()
        with pytest.raises(Stopped, match=reason):
            safe.act(u)
        np.testing.assert_array_equal(puppet.commands, [[0.0]])


def test_wrapped_angles_become_continuous():
    puppet = Puppet(hanging=(0, np.pi))
    safe = puppet.plant()
    puppet.q = np.array([0.0, -3.0])
    safe.reset()
    for angle in np.arange(3.2, 12.0, 0.5):
        puppet.q, puppet.t = np.array([0.0, np.remainder(angle + np.pi, 2 * np.pi) - np.pi]), puppet.t + 0.01
        assert safe.read()[1] == pytest.approx(angle)


def test_a_start_outside_the_limits_is_refused():
    puppet = Puppet()
    puppet.q = np.array([0.7, 0.0])
    with pytest.raises(InputError, match=r"'rail' is at 0\.7.*the start is outside"):
        puppet.plant().reset()
    puppet.q = np.zeros(3)
    with pytest.raises(InputError, match="expected 2 coordinates"):
        puppet.plant().reset()


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"goal": (1.0, np.pi)}, "goal is .* outside the limits"),
        ({"goal": (0.0, 0.0, np.pi)}, "goal is"),
        ({"goal": (0.5, np.pi), "position": [[-0.5, 0.5], [-4, 4]]}, "the goal of 'rail', 0.5, is at the end"),
        ({"position": [[-0.5, 0.5], [-np.pi, np.pi]]}, "the goal of 'hinge', 3.142, is at the end of its range"),
        ({"control": np.inf}, "finite, positive limits"),
        ({"rate": 0.0}, "rate is 0"),
        ({"position": [[0.5, -0.5], [-1, 1]]}, "position is"),
        ({"speed": -1.0}, "speed is"),
        ({"late": 1.0}, "late is 1.*expected more than 1"),
    ],
    ids=lambda case: case if isinstance(case, str) else next(iter(case)),
)
def test_a_layout_that_is_none_is_one_line(changed, message):
    with pytest.raises(InputError, match=message):
        described(**changed)


def test_a_plant_without_a_motor_or_without_a_passive_joint_is_refused():
    keywords = {"goal": (0, 0), "hanging": (0, np.pi), "rate": 100.0, "control": 1.0}
    for actuated, message in (([], "no joint has a motor"), ([0, 1], "none is passive"), ([2], "from 0 to 1")):
        with pytest.raises(InputError, match=message):
            layout(("revolute", "revolute"), actuated, **keywords)


def test_hardware_waits_for_the_next_sample_and_does_not_catch_up():
    now, slept = [0.0], []

    def sleep(seconds):
        slept.append(seconds)
        now[0] += seconds

    plant = hardware_plant(
        described(), reset=lambda: None, read=lambda: np.zeros(2), write=lambda u: now.__setitem__(0, now[0] + 0.004),
        clock=lambda: now[0], sleep=sleep,
    )  # fmt: skip
    plant.reset()
    plant.act([0.0])
    assert now[0] == pytest.approx(0.01) and slept == [pytest.approx(0.006)]
    now[0] += 0.05
    plant.act([0.0])  # late: acts at once
    assert len(slept) == 1
    plant.act([0.0])
    assert slept[-1] == pytest.approx(0.006)


def test_up_is_near_the_goal_for_the_last_second_without_a_stop():
    plant, t = described(), np.arange(500) / 100
    y = np.stack([np.zeros(500), np.where(t < 2, 0.0, 3 * np.pi)], axis=1)
    late = np.where(t[:, None] < 4.5, 0.0, y)
    runs = [PlantRun(t, y, t), PlantRun(t, y, t, "rail"), PlantRun(t, late, t), PlantRun(t, np.nan * y, t)]
    trials = judged_runs(runs, plant, seconds=5.0)
    np.testing.assert_array_equal(trials.up, [True, False, False, False])
    assert trials.seconds[0] == pytest.approx(2.0) and trials.stopped == ("rail",)


def test_a_push_reaches_the_plant_at_its_sample():
    puppet, still = Puppet(), Controller(np.zeros(()), lambda memory, t, y: (memory, np.zeros(1)))
    kicks = []
    plant = Plant(puppet.layout, lambda: None, lambda: puppet.q, puppet.act, lambda: puppet.t)
    kicked = plant._replace(kick=lambda rates: kicks.append((puppet.t, rates)))
    act, push = compiled(still, puppet.layout), Push(0.05, [0.0, 3.0])
    run([kicked], act, start_of(still, 1), seconds=0.1, push=push)
    ((t, rates),) = kicks
    assert t == pytest.approx(0.05)
    np.testing.assert_array_equal(rates, [0.0, 3.0])
    with pytest.raises(InputError, match="no kick"):
        run([plant], act, start_of(still, 1), seconds=0.1, push=push)


def test_compilation_is_no_late_answer():
    puppet, calls = Puppet(), []

    def act(memory, t, y):
        calls.append(t)
        puppet.t += 1.0 if len(calls) <= 2 else 0.0  # compilation for the first memory, and for later ones
        return memory, np.zeros((1, 1))

    plant = Plant(puppet.layout, lambda: None, lambda: puppet.q, puppet.act, lambda: puppet.t)
    (result,) = run([plant], act, np.zeros(1), seconds=0.1)
    assert not result.stopped and len(result.t) == 10


@pytest.mark.parametrize("failure", [KeyboardInterrupt, ValueError])
def test_an_interrupt_or_a_failure_of_the_law_leaves_the_motors_at_zero(failure):
    puppet = Puppet()

    def act(memory, t, y):
        if len(puppet.commands) == 3:
            raise failure
        return memory, np.ones((1, 1))

    plant = Plant(puppet.layout, lambda: None, lambda: puppet.q, puppet.act, lambda: puppet.t)
    with pytest.raises(failure):
        run([plant], act, np.zeros(1), seconds=1.0)
    np.testing.assert_array_equal(np.ravel(puppet.commands), [1.0, 1.0, 1.0, 0.0])


def test_a_run_states_the_times_of_the_answers_and_leaves_garbage_collection_as_it_was():
    puppet, late = Puppet(), np.array([0.0, 2e-3, 0.0, 5e-3, 1e-3])
    puppet.t = 7.0

    def act(u):
        number = len(puppet.commands) + 1
        puppet.act(u)
        puppet.t = 7.0 + 0.01 * number + late[number % len(late)]

    plant = Plant(puppet.layout, lambda: None, lambda: puppet.q, act, lambda: puppet.t)
    (result,) = run([plant], lambda memory, t, y: (memory, np.zeros((1, 1))), np.zeros(1), seconds=0.05)
    np.testing.assert_allclose(result.t, 0.01 * np.arange(5) + late, atol=1e-12)
    assert gc.get_freeze_count() == 0
