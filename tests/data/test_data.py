"""The schema, its refusals, splits by trajectory, and the generators' exactness."""

import json

import numpy as np
from calls import one_line
from numpy.testing import assert_allclose, assert_array_equal

from dln_jax import Needs
from dln_jax.data import schema
from dln_jax.data.joints import needs_from_json
from dln_jax.data.splits import PER_SAMPLE, merged, select, split
from dln_jax.scenes.datasets import generators
from dln_jax.scenes.pendulums import cart_pole, pendulum, two_link_arm


def arrays(samples=12, d=2, trajectories=3):
    random = np.random.default_rng(0)
    return {
        "t": np.tile(0.1 * np.arange(samples // trajectories), trajectories),
        **{key: random.normal(size=(samples, d)) for key in ("q", "qd", "qdd", "tau")},
        "trajectory": np.repeat(np.arange(trajectories), samples // trajectories),
        "label": np.array(["a", "b", "c"][:trajectories]),
    }


def changed(**changes):
    return {key: value for key, value in {**arrays(), **changes}.items() if value is not None}


def needing(**fields):
    return changed(needs=np.array(json.dumps({"joints": ["revolute"] * 2, **fields})))


REFUSED = [
    (changed(t=None), "key 't' is missing"),
    (changed(q=np.diag([np.nan] * 12)[:, :2]), "q has 2 NaN"),
    (changed(q=np.zeros(12)), r"q has shape \(12,\)"),
    (changed(q=np.zeros((1, 2))), r"1 sample\(s\)"),
    (changed(tau=np.zeros((12, 3))), r"tau has shape \(12, 3\); expected \(12, 2\)"),
    (changed(qd=np.array([["x"] * 2] * 12)), "qd has type"),
    (changed(t=np.zeros(12)), "t does not increase at sample 1 of trajectory 'a'"),
    (changed(trajectory=np.array([0, 1, 2] * 4)), "keep the samples of each trajectory together"),
    (changed(trajectory=-arrays()["trajectory"]), "not whole numbers >= 0"),
    (changed(label=np.array(["a"])), "label names 1 trajectories"),
    (changed(label=np.array(["a", "a", "b"])), "repeated names"),
    (changed(label=np.arange(3)), "one string per trajectory"),
    (changed(temperature=np.zeros((12, 3))), r"temperature has shape \(12, 3\)"),
    (changed(temperature=np.full(12, -300.0)), "below absolute zero"),
    *((changed(joint_names=np.array(names)), "expected 2 different strings") for names in (["a"], ["a", "a"], [1, 2])),
    (changed(needs=np.array('{"joints": [], "friction": true, "friction": false}')), "needs names 'friction' twice"),
    (needing(joints=["revolute"]), "states 1 joints, but q has 2"),
    (needing(joint_friction=["asymmetric", "coulomb"]), "no data can tell them apart"),
    (needing(joint_map=[[1, 0]]), "joint_map is"),
    (needing(joint_map=[[1, 1], [1, 1]]), "an invertible matrix"),
    (needing(velocity_scale=0), "velocity_scale is 0; expected a positive number"),
]


def test_what_breaks_the_schema_is_named():
    for content, message in REFUSED:
        with one_line(message):
            schema.from_arrays(content)


def test_saving_and_loading_is_the_identity(tmp_path):
    path = tmp_path / "data.npz"
    laws = {"joint_friction": ("viscous", "stribeck"), "joint_map": ((1.0, 0.0), (-1.0, 1.0)), "velocity_scale": 0.02}
    data = generators.uniform(two_link_arm(), samples=5)._replace(needs=Needs(("revolute",) * 2, **laws))
    schema.save(path, data)
    again = schema.load(path)
    assert again.needs == data.needs
    for key in (*PER_SAMPLE, "label"):
        assert_array_equal(getattr(again, key), getattr(data, key))
    for name, words in (("data.npz", "exists"), ("a/b.npz", "no such folder"), ("a.csv", r"ends in \.npz")):
        with one_line(words):
            schema.save(tmp_path / name, data)
    older = {"joints": ["revolute"], "gravity": True, "friction": False, "actuation": None}
    assert needs_from_json(older) == Needs(("revolute",))


def test_absent_rates_are_estimated_to_second_order_and_never_across_trajectories():
    errors = []
    for steps in (40, 80):
        t, trajectory = np.tile(np.linspace(0, 1, steps) ** 1.2, 2), np.repeat([0, 1], steps)
        phase = 3 * t + 10 * trajectory
        data = schema.from_arrays({"t": t, "q": np.sin(phase)[:, None], "trajectory": trajectory})
        assert data.estimated == ("qd", "qdd", "tau")
        errors.append(np.abs(data.qd[:, 0] - 3 * np.cos(phase)).max())
    assert errors[1] < 0.35 * errors[0]
    with one_line("qd is missing, and trajectory 0 has 2"):
        schema.time_derivative(np.arange(2.0), np.zeros((2, 1)), np.zeros(2, int), name="qd")


def test_split_is_by_trajectory_disjoint_complete_and_seeded():
    data = generators.uniform(two_link_arm(), samples=60)
    sets, again, other = (split(data, test=["state-3", "state-7"], seed=seed) for seed in (1, 1, 2))
    held = [part.trajectory.tolist() for part in sets]
    assert held[2] == [3, 7] and len(held[1]) == 6 and sorted(held[0] + held[1]) == [*{*range(60)} - {3, 7}]
    assert_array_equal(again.validation.q, sets.validation.q)
    assert not np.array_equal(other.validation.q, sets.validation.q)
    for key in ("t", "q", "tau", "trajectory", "tau_gravity"):
        assert_array_equal(getattr(merged(sets), key), getattr(data, key))


def test_splits_that_cannot_be_made_are_refused():
    data = generators.uniform(two_link_arm(), samples=3)
    assert [len(part.t) for part in split(data)] == [1, 1, 1]
    for given, labels, words in (
        (data, ["x"], "no trajectory is labelled 'x'; choose the test labels from: state-0"),
        (select(data, [0]), None, "at least 3 in all"),
        (data, ["state-0", "state-1"], "leave 1 for training"),
    ):
        with one_line(words):
            split(given, test=labels)


def test_letters_have_exact_rates_and_momenta_and_torques_that_are_sums():
    """Finite differences of a finer sampling converge to the stored rates at second order."""
    errors = []
    for dt in (0.02, 0.01):
        data = generators.characters(letters="e", dt=dt)
        assert_allclose(data.tau_inertial + data.tau_coriolis + data.tau_gravity, data.tau, atol=1e-12)
        for rate, source in (("qd", "q"), ("qdd", "qd"), ("pd", "p")):
            estimate = schema.time_derivative(data.t, getattr(data, source), data.trajectory, name=rate)
            errors.append(np.abs(estimate - getattr(data, rate))[2:-2].max())
    coarse, fine = np.array(errors).reshape(2, 3)
    assert (fine < 0.35 * coarse).all() and (fine < 0.1).all()


def test_uniform_states_fill_their_box_and_underactuated_scenes_are_driven_by_their_motors():
    data = generators.uniform(cart_pole(), samples=2000, position_bound=2.0, rate_bound=3.0)
    for states in (data.q / 2, data.qd / 3):
        assert 0.95 < np.abs(states).max() <= 1 and np.abs(states.mean(axis=0)).max() < 0.1
    assert_allclose(data.tau[:, 1], 0.0, atol=1e-12)
    assert np.abs(data.tau[:, 0]).max() > 1
    for bound in ("samples", "position_bound", "rate_bound"):
        with one_line(f"{bound} is 0"):
            generators.uniform(cart_pole(), **{bound: 0})


def test_free_swings_keep_their_energy():
    data = generators.free_swing(pendulum(), trajectories=2, steps=200)
    assert_array_equal(data.tau, 0.0)
    energy = 0.5 * data.qd * data.p - 9.81 * np.cos(data.q)
    assert_allclose(energy, np.repeat(energy[::200], 200, axis=0), rtol=1e-8)


def test_angles_that_wrap_are_unwrapped_and_nothing_else_is():
    """One joint turns several times, one swings about its stop at pi, and one does neither."""
    t = np.arange(600) / 100
    true = np.stack([3 * t, np.pi + 0.3 * np.sin(4 * t), np.cos(t)], axis=1)

    def read(q, **stated):
        return schema.from_arrays({"t": t, "q": q, "trajectory": np.zeros(600, int), **stated})

    assert read(true).remarks == ()
    wrapped = (true + np.pi) % (2 * np.pi) - np.pi
    data = read(wrapped)
    turns = (data.q - true) / (2 * np.pi)
    assert_allclose(turns, np.tile(np.round(turns[:1]), (600, 1)), atol=1e-12)
    assert "column 1, 2 of q wrap by 2 pi" in data.remarks[0] and np.abs(data.qd[:, 0]).max() < 3.1
    slides = read(wrapped, needs=np.array('{"joints": ["prismatic", "revolute", "revolute"]}'))
    assert "in column 2 of q" in slides.remarks[0]
    noise = np.random.default_rng(0).uniform(-np.pi, np.pi, (600, 3))
    assert_array_equal(read(noise).q, noise)
