"""The schema, its refusals, splits by trajectory, and the generators' exactness."""

import json
import pickle

import jax
import numpy as np
import pytest

from dln_jax.data import schema
from dln_jax.data.splits import PER_SAMPLE, merged, select, select_samples, split
from dln_jax.data.stated_needs import needs_from_json
from dln_jax.data.trajectory_times import time_derivative
from dln_jax.scenes.datasets import generators
from dln_jax.scenes.pendulums import double_pendulum, two_link_arm
from dln_jax.scenes.poles import cart_pole
from dln_jax.types import InputError, Needs


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


def with_value(key, value):
    array = arrays()[key].copy()
    array.flat[3] = value
    return changed(**{key: array})


REFUSED = [
    (changed(q=None), "key 'q' is missing"),
    (changed(t=None), "key 't' is missing"),
    (changed(trajectory=None), "t does not increase at sample 4 .* in a column 'trajectory'"),
    (with_value("q", np.nan), "q has 1 NaN"),
    (with_value("tau", np.inf), "tau has 1 NaN or infinite"),
    (changed(q=np.zeros(12)), r"q has shape \(12,\)"),
    (changed(q=np.zeros((12, 0))), "d >= 1"),
    (changed(q=np.zeros((1, 2))), r"1 sample\(s\)"),
    (changed(tau=np.zeros((12, 3))), r"tau has shape \(12, 3\); expected \(12, 2\)"),
    (changed(qd=np.array([["x"] * 2] * 12)), "qd has type"),
    (changed(t=np.zeros(12)), "t does not increase at sample 1 of trajectory 'a'"),
    (changed(trajectory=np.array([0, 1, 2] * 4)), "keep the samples of each trajectory together"),
    (changed(trajectory=np.full(12, 0.5)), "not whole numbers"),
    (changed(trajectory=-arrays()["trajectory"]), "not whole numbers >= 0"),
    (changed(label=np.array(["a"])), "label names 1 trajectories"),
    (changed(label=np.array(["a", "a", "b"])), "repeated names"),
    (changed(label=np.arange(3)), "one string per trajectory"),
    (changed(needs=np.array("{not json")), "needs is not JSON"),
    (changed(needs=np.array('{"joints": ["ball"]}')), "expected a tuple of revolute, prismatic"),
    (changed(needs=np.array('{"joints": [], "friction": true, "friction": false}')), "needs names 'friction' twice"),
    (changed(needs=np.array('{"joints": ["revolute"]}')), "states 1 joints, but q has 2"),
    (
        changed(needs=np.array('{"joints": ["revolute", "revolute"], "wind": true}')),
        "expected the fields joints",
    ),
    (changed(needs=np.array('{"joints": ["revolute", "revolute"], "gravity": 1}')), "gravity is 1"),
    (changed(needs=np.array('{"joints": ["revolute", "revolute"], "actuation": [[1]]}')), "actuation is"),
    *(
        (changed(needs=np.array(json.dumps({"joints": ["revolute"] * 2, key: value}))), message)
        for key, value, message in (
            ("joint_friction", ["viscous", "rust"], "joint_friction has 'rust'; expected some of viscous, coulomb"),
            ("joint_friction", "viscous", "joint_friction: 'viscous'; expected a tuple of viscous"),
            ("joint_friction", ["asymmetric", "coulomb"], "which no data can tell apart"),
            ("joint_map", [[1, 0]], "joint_map is"),
            ("joint_map", [[1, 1], [1, 1]], "an invertible matrix"),
            ("velocity_scale", 0, "velocity_scale is 0; expected a positive number"),
        )
    ),
]


@pytest.mark.parametrize(("content", "message"), REFUSED, ids=[message for _, message in REFUSED])
def test_what_breaks_the_schema_is_named(tmp_path, content, message):
    path = tmp_path / "data.npz"
    np.savez(path, **content)
    with pytest.raises(InputError, match=message) as caught:
        schema.load(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_files_that_are_no_archive_are_refused_and_nothing_is_unpickled(tmp_path):
    path = tmp_path / "data.npz"
    with pytest.raises(InputError, match="no such file"):
        schema.load(path)

    class Bomb:
        def __reduce__(self):
            return (pytest.fail, ("a pickle was executed",))

    path.write_bytes(pickle.dumps(Bomb()))
    with pytest.raises(InputError, match="without pickled objects"):
        schema.load(path)
    np.savez(path, **{**arrays(), "q": np.array([Bomb()], dtype=object)})
    with pytest.raises(InputError, match="without pickled objects"):
        schema.load(path)
    np.savez(path, **arrays())
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(InputError, match="without pickled objects"):
        schema.load(path)


def test_saving_and_loading_is_the_identity(tmp_path):
    data = generators.uniform(cart_pole(), samples=5)
    schema.save(tmp_path / "data.npz", data)
    again = schema.load(tmp_path / "data.npz")
    assert again.needs == cart_pole().needs
    for key in (*PER_SAMPLE, "label"):
        np.testing.assert_array_equal(getattr(again, key), getattr(data, key))
    with pytest.raises(InputError, match="exists"):
        schema.save(tmp_path / "data.npz", data)
    with pytest.raises(InputError, match="no such folder"):
        schema.save(tmp_path / "nowhere" / "data.npz", data)
    with pytest.raises(InputError, match=r"end in \.npz"):
        schema.save(tmp_path / "data.csv", data)


def test_friction_of_joints_is_stated_in_a_file_and_older_needs_have_none(tmp_path):
    laws, rows = ("viscous", "stribeck"), ((1.0, 0.0), (-1.0, 1.0))
    needs = Needs(("revolute",) * 2, joint_friction=laws, joint_map=rows, velocity_scale=0.02)
    data = schema.from_arrays(arrays())._replace(needs=needs)
    schema.save(tmp_path / "data.npz", data)
    assert schema.load(tmp_path / "data.npz").needs == needs
    older = {"joints": ["revolute"], "gravity": True, "friction": False, "actuation": None}
    assert needs_from_json(older) == Needs(("revolute",))


def test_absent_rates_are_estimated_to_second_order_and_never_across_trajectories():
    errors = []
    for steps in (40, 80):
        t = np.tile(np.linspace(0, 1, steps) ** 1.2, 2)
        trajectory = np.repeat([0, 1], steps)
        q = np.sin(3 * t + 10 * trajectory)[:, None]
        data = schema.from_arrays({"t": t, "q": q, "trajectory": trajectory})
        assert data.estimated == ("qd", "qdd", "tau")
        errors.append(np.abs(data.qd[:, 0] - 3 * np.cos(3 * t + 10 * trajectory)).max())
    assert errors[1] < 0.35 * errors[0]


def test_a_rate_cannot_be_estimated_from_two_samples():
    with pytest.raises(InputError, match="qd is missing, and trajectory 0 has 2"):
        time_derivative(np.arange(2.0), np.zeros((2, 1)), np.zeros(2, int), name="qd")


def test_split_is_by_trajectory_disjoint_complete_and_seeded():
    data = generators.uniform(two_link_arm(), samples=60)
    sets = split(data, test=["state-3", "state-7"], seed=1)
    held = [set(part.trajectory.tolist()) for part in sets]
    assert held[2] == {3, 7} and set.union(*held) == set(range(60)) and sum(map(len, held)) == 60
    assert len(held[1]) == 6
    again, other = (split(data, test=["state-3", "state-7"], seed=seed) for seed in (1, 2))
    np.testing.assert_array_equal(again.validation.q, sets.validation.q)
    assert not np.array_equal(other.validation.q, sets.validation.q)
    for key in ("t", "q", "tau", "trajectory", "tau_gravity"):
        np.testing.assert_array_equal(getattr(merged(sets), key), getattr(data, key))
    np.testing.assert_array_equal(select(data, [5]).q, data.q[5:6])


def test_splits_that_cannot_be_made_are_refused():
    data = generators.uniform(two_link_arm(), samples=3)
    assert [len(part.t) for part in split(data)] == [1, 1, 1]
    with pytest.raises(InputError, match="no trajectory is labelled 'x'; choose the test labels from: state-0"):
        split(data, test=["x"])
    with pytest.raises(InputError, match="at least 3 in all"):
        split(select(data, [0]))
    with pytest.raises(InputError, match="leave 1 for training"):
        split(data, test=["state-0", "state-1"])


@pytest.fixture(scope="module")
def letters():
    return generators.characters(letters="elv")


def test_letters_are_consistent_trajectories(letters):
    assert letters.needs == Needs(("revolute", "revolute"))
    assert list(letters.label) == ["e", "l", "v"]
    parts = letters.tau_inertial + letters.tau_coriolis + letters.tau_gravity
    np.testing.assert_allclose(parts, letters.tau, atol=1e-12)
    for index in range(3):
        inside = letters.trajectory == index
        # At rest at both ends but for the last fraction of a sample.
        assert np.abs(letters.qd[inside][0]).max() < 1e-12
        assert np.abs(letters.qd[inside][-1]).max() < 0.05
    absent = ("needs", "estimated", "joint_names")
    schema.from_arrays({key: value for key, value in letters._asdict().items() if key not in absent})


def test_letters_have_exact_rates_and_momenta(letters):
    """Finite differences of a finer sampling converge to the stored rates at second order."""
    errors = []
    for dt in (0.02, 0.01):
        fine = generators.characters(letters="e", dt=dt)
        inside = slice(2, -2)
        for rate, source in (("qd", "q"), ("qdd", "qd"), ("pd", "p")):
            estimate = time_derivative(fine.t, getattr(fine, source), fine.trajectory, name=rate)
            errors.append(np.abs(estimate - getattr(fine, rate))[inside].max())
    coarse, fine = np.array(errors).reshape(2, 3)
    assert (fine < 0.35 * coarse).all() and (fine < 0.1).all()


def test_uniform_states_fill_their_box():
    data = generators.uniform(two_link_arm(), samples=2000, position_bound=2.0, rate_bound=3.0)
    assert 1.9 < np.abs(data.q).max() <= 2.0 and 2.9 < np.abs(data.qd).max() <= 3.0
    assert np.abs(data.q.mean(axis=0)).max() < 0.1
    np.testing.assert_array_equal(data.q, generators.uniform(two_link_arm(), samples=2000, position_bound=2.0).q)


def test_an_underactuated_scene_is_driven_through_its_motors_only():
    data = generators.uniform(cart_pole(), samples=50)
    np.testing.assert_allclose(data.tau[:, 1], 0.0, atol=1e-12)
    assert np.abs(data.tau[:, 0]).max() > 1


@pytest.mark.parametrize("friction", [0.0, 0.4])
def test_free_swings_keep_or_lose_energy(friction):
    scene = double_pendulum(friction=friction)
    data = generators.free_swing(scene, trajectories=2, steps=200)
    np.testing.assert_array_equal(data.tau, 0.0)
    kinetic = 0.5 * np.sum(data.qd * data.p, axis=1)
    potential = jax.jit(jax.vmap(scene.potential))(data.q)
    energy = (kinetic + potential).reshape(2, 200)
    if friction:
        assert (np.diff(energy, axis=1) < 0).all()
    else:
        np.testing.assert_allclose(energy, energy[:, :1] * np.ones(200), rtol=1e-8)


@pytest.mark.parametrize("bound", [{"samples": 0}, {"position_bound": 0.0}, {"rate_bound": np.nan}], ids=str)
def test_boxes_of_no_size_are_refused(bound):
    with pytest.raises(InputError, match=f"{next(iter(bound))} is (0|nan)"):
        generators.uniform(two_link_arm(), **bound)


def test_temperature_is_one_for_all_joints_or_one_for_each():
    log = {"t": np.arange(3.0), "q": np.zeros((3, 2)), "trajectory": np.zeros(3, int)}
    common = schema.from_arrays({**log, "temperature": np.array([20.0, 21, 22])})
    np.testing.assert_array_equal(common.temperature, [[20, 20], [21, 21], [22, 22]])
    own = schema.from_arrays({**log, "temperature": common.temperature + np.array([0.0, 5.0])})
    np.testing.assert_array_equal(select_samples(own, np.array([2])).temperature, [[22, 27]])
    for wrong, message in (
        (np.zeros((3, 3)), r"temperature has shape \(3, 3\)"),
        (np.full(3, np.nan), "temperature has 3 NaN"),
        (np.full(3, -300.0), "below absolute zero"),
    ):
        with pytest.raises(InputError, match=message):
            schema.from_arrays({**log, "temperature": wrong})
