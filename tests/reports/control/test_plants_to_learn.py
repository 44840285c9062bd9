"""The plants that the report learns: they hang at rest, draws of their sizes differ, and the rig obeys mechanics."""

import math
import random

import numpy as np
import pytest

from scripts.reports.control import rig
from scripts.reports.control.foreign_plants import SUBJECTS
from scripts.reports.control.late_answers import late_plant

MADE = [(subject, name) for subject, plants in SUBJECTS.items() for name in plants]


@pytest.mark.parametrize(("subject", "name"), MADE)
def test_a_plant_starts_near_hanging_and_stays_there_without_controls(subject, name):
    plant = SUBJECTS[subject][name](0, 1)
    layout, seen = plant.layout, []
    plant.reset()
    for _ in range(100):
        seen.append(plant.read())
        plant.act(np.zeros(layout.actuation.shape[1]))
    away = np.abs(np.remainder(np.array(seen) - layout.hanging + np.pi, 2 * np.pi) - np.pi).max()
    assert 1e-4 < away < 0.7  # the deviation of a start is 0.1
    assert plant.time() == pytest.approx(100 / layout.rate)


@pytest.mark.parametrize(
    ("subject", "name"), [("foreign", "cart-pole"), ("chains", "passive-last"), ("urdf", "acrobot")]
)
def test_draws_of_the_sizes_differ(subject, name):
    ends = []
    for sizes in (0, 1):
        plant = SUBJECTS[subject][name](sizes, 1)
        plant.reset()
        for _ in range(50):
            plant.act(plant.layout.limits.control[:, 1] / 2)
        ends.append(plant.read())
    assert np.abs(ends[0] - ends[1]).max() > 1e-3


def test_samples_of_the_late_plant_are_late_and_its_motor_follows_ten_milliseconds_after():
    plant, times = late_plant(3e-3, 0), []
    plant.reset()
    for number in range(1000):
        plant.read()
        times.append(plant.time())
        plant.act(np.full(1, 0.01 * (number > 990)))
    late = np.array(times) - times[0] - 0.01 * np.arange(1000)
    mean = 3e-3 * (1 - math.exp(-3))  # of what is cut off at 9 ms
    assert np.mean(late - late.min()) == pytest.approx(mean, rel=0.1) and 8e-3 < np.ptp(late) < 9.1e-3
    driven, idle = (rig.Pendulum(random.Random(0)) for _ in range(2))
    driven.command(0.0, 0.05)
    for now, differ in ((0.010, False), (0.012, True)):
        for pendulum in (driven, idle):
            pendulum.seen(now)
        assert (driven.v[0] - idle.v[0] > 0.1) == differ == (driven.v != idle.v)


def test_the_rig_conserves_energy_without_friction(monkeypatch):
    for name in ("DRY", "BEARING", "HINGE"):
        monkeypatch.setattr(rig, name, 0.0)

    def energy(q, v):
        sine, cosine = math.sin(q[1]), math.cos(q[1])
        kinetic = (rig.ARM + rig.SINE * sine**2) * v[0] ** 2 + rig.POLE * v[1] ** 2
        return kinetic / 2 + rig.COUPLING * cosine * v[0] * v[1] + rig.WEIGHT * cosine

    q, v, step, energies = [0.0, 2.0], [3.0, 0.0], 2e-5, []
    for _ in range(50_000):
        rates = rig.accelerations(q, v, 0.0)
        v = [rate + step * change for rate, change in zip(v, rates, strict=True)]
        q = [angle + step * rate for angle, rate in zip(q, v, strict=True)]
        energies.append(energy(q, v))
    assert np.ptp(energies) < 1e-3 * rig.WEIGHT
