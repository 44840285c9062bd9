"""Verdicts beyond errors on held-out motions: agreement of descents, heavy bodies, friction, spikes."""

from types import SimpleNamespace

import numpy as np

from dln_jax.commands.identification.verdict import friction_verdict, spikes, weight_verdict
from dln_jax.metrics.verdict import HeldOut
from dln_jax.runs.verdict import verdict_on_search


def test_learned_tree_says_how_its_frames_were_found():
    for agreeing, error, noise, said in [
        (5, 1e-4, 1e-4, ""),
        (1, 1e-4, 1e-4, ""),  # at the noise there is nothing lower
        (1, 3e-4, 1e-4, "only 1 of 31 starts reached the lowest loss"),
        (1, 3e-4, None, "only 1 of 31 starts"),
        (5, 3e-4, 1e-4, ""),
        (5, 5e-4, 1e-4, "held-out errors are 5 times the noise, although 5 starts agree"),
        (5, 5e-4, None, ""),
    ]:
        known = None if noise is None else np.full(2, noise)
        held_out = HeldOut(np.full(2, error), np.ones(2), np.ones(2), known)
        search = SimpleNamespace(losses=np.arange(31.0), agreeing=agreeing, agreement=5, twin=None)
        verdict, numbers = verdict_on_search(search, held_out)
        assert numbers["descents"] == 31 and numbers["descents_agreeing"] == agreeing
        assert said in verdict.reason and verdict.level == "doubtful" if said else verdict is None


def test_bodies_are_compared_with_the_file():
    random = np.random.default_rng(0).normal(size=(100, 4))
    torques = random[:, :3] * [100, 1, 0]
    for factor, level in (
        *((1.5, "good"), (0.3, "good"), (10, "doubtful"), (0.1, "doubtful"), (1e3, "refused"), (1e-3, "refused")),
        # A payload, or a flange without mass in the file, is no unit error.
        ([1.3, 4, 1], "good"),
    ):
        assert weight_verdict(factor * torques + [0, 0, 0.005], torques).level == level
    # A unit error in one joint of a SCARA.
    scara = random * [8, 4, 20, 0.1]
    for wrong, factor in ((0, 1e3), (1, 1e-3), (2, 1e3), (2, 1e-3), (3, 1e3)):
        verdict = weight_verdict(scara * np.where(np.arange(4) == wrong, factor, 1), scara)
        assert verdict.level == "doubtful" and f"in joint {wrong + 1}" in verdict.reason


def test_friction_that_drives_is_refused_and_a_fast_scale_doubted():
    qd = np.random.default_rng(0).uniform(-1, 1, (500, 2))
    tau = 3 * np.where(np.arange(500) % 2, 1, -1)[:, None] + qd
    for friction, scale, level in (
        (np.tanh(qd / 0.1), 0.1, "good"),
        (np.tanh(qd / [0.1, 1.5]), 1.5, "doubtful"),
        (1e-3 * np.tanh(qd / [0.1, 1.5]), 1.5, "good"),
        (qd * [1.0, -1.8], 0.1, "refused"),
    ):
        verdict = friction_verdict(("hip", "knee"), qd, tau, friction, np.array([0.1, scale]))
        assert verdict.level == level and ("friction of knee adds energy" in verdict.reason) == (level == "refused")


def test_spikes_are_single_samples_and_dry_friction_has_none():
    t = np.arange(0, 20, 0.01)
    torque = np.stack([5 * np.sin(2 * t) + 2 * np.sign(np.cos(3 * t)), np.sign(np.sin(t))], axis=1)
    torque += 0.05 * np.random.default_rng(0).normal(size=torque.shape)
    assert not spikes(torque).any()
    torque[[300, 700], [0, 1]] += 60
    assert np.argwhere(spikes(torque)).tolist() == [[300, 0], [700, 1]]
