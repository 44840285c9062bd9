"""A command's limit of time counts from its start, and all of its fits share what is left."""

import math
import time
from types import SimpleNamespace

import numpy as np
import pytest

from dln_jax.commands import train_delan
from dln_jax.data import schema
from dln_jax.learning.engine.problem import Progress, Stop, Training
from dln_jax.learning.fits import network
from dln_jax.process import SOON, counting_from, deadline, seconds_left
from dln_jax.scenes.datasets import generators
from dln_jax.scenes.pendulums import chain
from tests.calls import command


@pytest.fixture
def clock(monkeypatch):
    now = SimpleNamespace(time=1000.0)
    monkeypatch.setattr(time, "perf_counter", lambda: now.time)
    return now


def test_seconds_count_from_the_start_of_the_command_or_else_from_now(clock):
    assert deadline(60.0) == 1060.0 and deadline(None) == math.inf
    with counting_from(980.0):
        assert seconds_left(deadline(60.0)) == 40.0
        clock.time = 1050.0
        assert seconds_left(deadline(60.0)) == SOON
    assert deadline(60.0) == 1110.0


@pytest.fixture
def arm(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    schema.save("arm.npz", generators.uniform(chain(1), samples=60, rate_bound=2.0, acceleration_bound=5.0))
    return ("--data", "arm.npz", "--model", "structured-delan", "--seconds", "30", "--out", "run")


def training(validation):
    """A fit of one step."""
    return Training({}, [Progress(1, 1.0, validation, 1.0, 0.0)], Stop("finished", 1), 1, 0.0)


class Enough(Exception):
    """Ends a command whose limit has been seen."""


def test_growing_networks_share_one_limit(arm, clock, monkeypatch):
    """Each takes 20 s: the second ends beyond 30 s, and no third is begun."""
    left = []

    def train_plan(plan, sets, context, **_):
        left.append(context.seconds)
        clock.time += 20.0
        return training(1.0 / len(left))

    def ended(*_):
        raise Enough

    monkeypatch.setattr(network, "train_plan", train_plan)
    monkeypatch.setattr(network, "latency_of", lambda *_, **__: SimpleNamespace(p50_us=1.0))
    monkeypatch.setattr(network, "say_selection", ended)
    with pytest.raises(Enough):
        command(train_delan, *arm, "--target", "1e-9")
    assert left == [30.0, 10.0]


@pytest.mark.slow
def test_folds_share_the_limit_with_the_training(arm, clock, monkeypatch):
    """Three folds and the training of all have a quarter each of the 30 s."""
    limits = []

    def fit(problem, optimiser, *, seconds, **_):
        limits.append(seconds)
        clock.time += seconds
        if len(limits) == 4:
            raise Enough
        return training(np.ones(2))

    monkeypatch.setattr(network, "train", fit)
    with pytest.raises(Enough):
        command(train_delan, *arm, "--seeds", "2")
    assert limits == pytest.approx([7.5] * 4)
