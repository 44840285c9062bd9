"""Networks of many joints: small ones while motions show little, large ones where they show more, however sampled."""

import numpy as np

from dln_jax.data.schema import from_arrays
from dln_jax.learning.dynamics import independent_equations, suited_network
from dln_jax.types import Needs

D = 4
NEEDS = Needs(joints=("revolute",) * D)


def motion(seconds, rate):
    """Accelerations in a band of 0.5 Hz."""
    t = np.arange(0, seconds, 1 / rate)
    random = np.random.default_rng(0)
    frequencies, phases = random.uniform(0.05, 0.5, (2, 40, D, 1)) * np.array([1, 40])[:, None, None, None]
    qdd = np.cos(2 * np.pi * frequencies * t + phases).sum(axis=0).T
    return from_arrays({"t": t, "q": qdd, "qd": qdd, "qdd": qdd, "tau": qdd, "trajectory": np.zeros(len(t), int)})


def test_samples_that_follow_each_other_more_closely_say_no_more():
    few, many = (independent_equations(motion(200, rate)) for rate in (10, 50))
    assert few < 0.2 * 10 * 200 * D
    assert abs(many - few) < 0.1 * few


def test_what_motions_show_decides_between_a_small_network_and_a_large_one():
    small, large = (suited_network(NEEDS, motion(seconds, 10)) for seconds in (100, 3000))
    assert small.optimizer == "gauss-newton" and small.keywords["width"] == 16 and small.keywords["shared_trunk"]
    assert small.samples is not None and small.samples * D > 10 * 331
    assert large.optimizer == "adam" and large.samples is None and "331 parameters" in large.reason
