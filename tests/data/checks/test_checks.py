"""Every check finds the fault that is planted, names its joint, and is silent on data without it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from motions import sums_of_sines

from dln_jax.data.checks.channels import check_derivatives, flat_share
from dln_jax.data.checks.priors import STRONGEST, WEAKEST, Explanation, covariances
from dln_jax.data.checks.report import examine, quick, read, report
from dln_jax.data.checks.torques import decisive
from dln_jax.data.encoders.sampling import step_of
from dln_jax.data.encoders.smoothing import smooth
from dln_jax.data.log import FILTERED, log_of
from dln_jax.data.robots import Robot
from dln_jax.data.schema import from_arrays
from dln_jax.mechanics.trees.description import dh_frames, serial
from dln_jax.mechanics.trees.inertia import inertial_parameters
from dln_jax.mechanics.trees.recursions import newton_euler
from dln_jax.scenes.datasets import generators
from dln_jax.scenes.pendulums import cart_pole

SAMPLES, RUNS = 700, 4
RIGHT = np.pi / 2
UPRIGHT, LYING = (0.0, -9.81, 0.0), (0.0, 0.0, -9.81)


def robot_of(tree):
    d = len(tree.joints)
    wide = np.tile([-np.inf, np.inf], (d, 1))
    return Robot(tree, np.zeros(d), np.zeros(d), wide, wide)


def arm(gravity=LYING):
    """Three joints: a vertical one, then two across it."""
    rows = [[0, 0, 0.3, 0], [-RIGHT, 0.05, 0, -RIGHT], [0, 0.4, 0, 0]]
    links = [
        inertial_parameters(mass, centre, size * np.eye(3))
        for mass, centre, size in ((3.0, [0, 0, -0.1], 0.02), (2.5, [0.2, 0, 0], 0.03), (1.0, [0.15, 0.02, 0], 0.01))
    ]
    tree = serial(*dh_frames(rows), links, armature=np.array([0.1, 0.1, 0.02]), gravity=gravity)
    return robot_of(tree._replace(names=("base", "shoulder", "elbow")))


def planar(gravity, masses=(3.0, 1.5)):
    """Joints with parallel axes, as the first two of a SCARA if gravity is along them."""
    links = [inertial_parameters(mass, [0.2, 0.01, 0], mass * 0.02 * np.eye(3)) for mass in masses]
    frames = dh_frames([[0, 0.4 * (k > 0), 0, 0] for k in range(len(masses))])
    return robot_of(serial(*frames, links, gravity=gravity))


def motions(seed):
    """t, and q, qd and qdd [RUNS, SAMPLES, 3] of sums of sines."""
    random = np.random.default_rng(seed)
    t = np.arange(SAMPLES) / 100
    rates = 2 * np.pi * np.array([0.15, 0.4, 0.7, 1.1])
    sizes = np.array([1.0, 0.7, 0.4, 0.25]) * random.uniform(0.4, 1.2, (RUNS, 3, 4))
    phases = random.uniform(0, 2 * np.pi, (RUNS, 3, 4))
    runs = [sums_of_sines(t, size, rates, phase) for size, phase in zip(sizes, phases, strict=True)]
    return t, *np.stack(runs, axis=1)


def inverse_dynamics(tree, *states):
    return np.asarray(jax.jit(jax.vmap(lambda *state: newton_euler(tree, *state)))(*states))


@pytest.fixture(scope="module")
def clean():
    """Arrays of a log of the arm with friction, its encoders' and torques' noise, and true rates."""
    t, *states = motions(seed=1)
    q, qd, qdd = (x.reshape(-1, 3) for x in states)
    tau = inverse_dynamics(arm().tree, q, qd, qdd) + qd * [0.4, 0.4, 0.1] + np.tanh(qd / 0.02) * [0.8, 0.8, 0.15]
    random = np.random.default_rng(2)
    return {
        "t": np.tile(t, RUNS),
        "q": q + 2e-5 * random.normal(size=q.shape),
        "qd": qd,
        "tau": tau + np.array([0.15, 0.1, 0.02]) * random.normal(size=tau.shape),
        "trajectory": np.repeat(np.arange(RUNS), SAMPLES),
        "needs": np.array('{"joints": ["revolute", "revolute", "revolute"], "friction": true}'),
    }


def spoiled(arrays, plant):
    """The trajectories of a log with a planted fault; `None` takes a key away."""
    given = {**arrays, **plant(arrays)}
    return from_arrays({key: value for key, value in given.items() if value is not None})


def of_joint(key, joint, change):
    """A fault of one channel."""

    def plant(arrays):
        values = arrays[key].copy()
        values[:, joint] = change(values[:, joint])
        return {key: values}

    return plant


def late(array, samples):
    """Each run so many samples later; its first value is repeated."""
    runs = array.reshape(RUNS, SAMPLES, -1)
    return np.concatenate([np.repeat(runs[:, :1], samples, 1), runs[:, :-samples]], 1).reshape(array.shape)


def jittered(arrays):
    return {"t": arrays["t"] + np.random.default_rng(0).uniform(0, 0.003, len(arrays["t"])), **SILENT}


def only(arrays, kept):
    return {**{key: value[kept] for key, value in arrays.items() if key != "needs"}, **SILENT}


def with_spikes(arrays):
    tau = arrays["tau"].copy()
    tau[100::500, 2] += 5 * tau[:, 2].std()
    return {"tau": tau}


def with_repeats(arrays):
    rows = np.arange(100, len(arrays["t"]) - 5, 101)
    changed = {key: arrays[key].copy() for key in ("q", "qd", "tau")}
    for values in changed.values():
        values[rows] = values[rows - 1]
    return changed


# Torques take most of the time to check and have no part in faults of t and q.
SILENT = {"tau": None}
RATELESS = {"qd": None}
FAULTS = {
    "q in degrees": (lambda a: {"q": np.degrees(a["q"])}, "qd-unit", (0, 1, 2), "q from degrees"),
    "all in degrees": (lambda a: {"q": np.degrees(a["q"]), **RATELESS}, "q-unit", None, "degrees"),
    "qd of a motor": (of_joint("qd", 1, lambda x: 50 * x), "qd-unit", (1,), "50"),
    "qd late": (lambda a: {"qd": late(a["qd"], 3), **SILENT}, "qd-delay", (0, 1, 2), "30 ms late"),
    "qd of other joints": (lambda a: {"qd": a["qd"][:, [1, 0, 2]]}, "qd-unlike", (0, 1), "order"),
    "qd and qdd exchanged": (
        lambda a: {"qd": motions(seed=1)[3].reshape(-1, 3), "qdd": a["qd"]}, "qd-exchanged", (), "exchange"
    ),
    "milliseconds": (lambda a: {"t": 1000 * a["t"]}, "time-unit", (), "seconds"),
    "jitter": (lambda a: {**jittered(a), **RATELESS}, "jitter", (), "vary by"),
    "stamps of arrival": (jittered, "arrival", (), "whole multiples of 10 ms"),
    "gap": (lambda a: only(a, np.delete(np.arange(len(a["t"])), np.s_[200:300])), "gaps", (), "1 gap"),
    "one run": (lambda a: only(a, a["trajectory"] == 0), "split", (), "trajectories is 1"),
    "repeated rows": (with_repeats, "repeated", (), "27 of rows"),
    "torque turned round": (of_joint("tau", 1, np.negative), "torque-sign", (1,), "sign"),
    "torques exchanged": (lambda a: {"tau": a["tau"][:, [0, 2, 1]]}, "order", (1, 2), "1, 3, 2"),
    "torques late": (lambda a: {"tau": late(a["tau"], 8)}, "delay", (), "late"),
    "torques cut off": (lambda a: {"tau": np.clip(a["tau"], -6, 6)}, "saturation-tau", None, "cut off"),
    "q cut off": (of_joint("q", 2, lambda x: np.minimum(x, 0.6 * x.max())), "saturation-q", (2,), "flat"),
    "still": (of_joint("q", 2, np.ones_like), "unexcited", (2,), "is constant"),
    "hardly moved": (of_joint("q", 2, lambda x: 0.001 * x), "unexcited", (2,), "less than"),
    "steps": (
        lambda a: {"q": np.round(a["q"] / 2e-3) * 2e-3, **SILENT}, "quantisation", (0, 1, 2), "up to 0.002"
    ),
    "noisy q": (
        lambda a: {"q": a["q"] + 3e-4 * np.random.default_rng(0).normal(size=a["q"].shape), **SILENT, **RATELESS},
        *("raw-differences", (), "--cutoff auto"),
    ),
    "constant torque": (of_joint("tau", 0, lambda x: 0 * x + 2), "constant-torque", (0,), "constant"),
    "all torques dead": (lambda a: {"tau": 0 * a["tau"]}, "dead-torque", (0, 1, 2), "zero"),
    "small torques hidden": (
        of_joint("tau", 2, lambda x: np.where(np.abs(x) > np.quantile(np.abs(x), 0.7), x, 0)),
        *("hidden-torque", (2,), "exactly zero in up to"),
    ),
    "friction not stated": (lambda a: {"needs": None}, "friction", None, "friction is seen"),
    # Against the robot.
    "all torques turned round": (lambda a: {"tau": -a["tau"]}, "tree-sign", (0, 1, 2), "", arm()),
    "motor's torque": (lambda a: {"tau": a["tau"] / 100}, "gear", (0, 1, 2), "", arm()),
    "columns exchanged": (lambda a: {key: a[key][:, [0, 2, 1]] for key in ("q", "qd", "tau")}, "order", (), "", arm()),
    "upside down": (lambda a: {}, "gravity", (), "-9.", arm(gravity=(0.0, 0.0, 9.81))),
    "torques later than the robot's": (lambda a: {"tau": late(a["tau"], 2)}, "delay", (), "20.", arm()),
    "beyond limits": (
        lambda a: {}, "limits", (0, 1, 2), "", arm()._replace(position_limits=np.tile([-0.5, 0.5], (3, 1)))
    ),
    "dead torque": (of_joint("tau", 1, np.zeros_like), "dead-torque", (1,), "", arm()),  # which overflowed once
}  # fmt: skip


def test_nothing_is_found_in_clean_logs(clean):
    assert quick(from_arrays(clean)) == []
    assert quick(spoiled(clean, lambda a: {"q": motions(seed=1)[1].reshape(-1, 3), **RATELESS})) == []
    assert quick(generators.uniform(cart_pole(), samples=200)) == []
    assert quick(generators.characters()) == []


@pytest.mark.parametrize("name", FAULTS)
def test_a_planted_fault_is_found(clean, name):
    plant, check, joints, word, *robot = FAULTS[name]
    findings = quick(spoiled(clean, plant), *robot)
    found = [finding for finding in findings if finding.check == check]
    assert found, f"{check} is not among {[finding.line for finding in findings]}"
    assert word in found[0].line and "\n" not in found[0].line and found[0].remedy
    assert joints is None or found[0].joints == joints


def test_a_clean_log_suits_its_robot(clean):
    examined = examine(from_arrays(clean), arm())
    on_tree = examined.on_tree
    assert examined.findings == [] and "no faults found" in report(examined, "log.npz")
    assert on_tree.scale == pytest.approx(np.ones(3), rel=0.1)
    assert on_tree.gravity == pytest.approx([0, 0, -9.81], abs=0.3)
    assert abs(examined.torques.likely_delay) < 0.2
    assert examined.torques.coulomb == pytest.approx([0.8, 0.8, 0.15], rel=0.15)
    assert 0 < on_tree.rank < on_tree.parameters and 1 < on_tree.condition < 1000


def test_rough_masses_of_a_file_are_no_fault_of_the_log(clean):
    rough = arm()
    rough = rough._replace(tree=rough.tree._replace(inertias=np.array([[1.3], [0.7], [1.2]]) * rough.tree.inertias))
    assert errors({key: x for key, x in clean.items() if key != "qd"}, rough) == []


def test_a_tilt_and_a_wrong_clock_are_found_with_the_robot(clean):
    tilted = arm(gravity=(9.81 * np.sin(0.3), 0.0, -9.81 * np.cos(0.3)))
    (finding,) = examine(from_arrays(clean), tilted).on_tree.findings
    assert finding.check == "gravity" and "17 degrees" in finding.observation
    examined = examine(spoiled(clean, lambda a: {"t": 1.25 * a["t"], **RATELESS}), arm())
    # A filter settles no error of the clock.
    errors = {finding.check for finding in examined.findings if finding.severity == "error"}
    assert errors == {"clock"} and not errors & {*FILTERED} and "arrival" in FILTERED
    assert examined.torques.repaired.log.speed == pytest.approx(1.25, rel=0.03)


def test_times_out_of_order_or_double_are_repaired_and_said(clean, tmp_path):
    order = np.random.default_rng(0).permutation(len(clean["t"]))
    arrays = {key: x if key == "needs" else x[np.r_[order, order[:5]]] for key, x in clean.items()}
    np.savez(tmp_path / "log.npz", **arrays, joint_names=np.array(["elbow", "base", "shoulder"]))
    data, repaired = read(tmp_path / "log.npz")
    assert np.array_equal(data.q, clean["q"]) and data.needs.friction
    found = {finding.check for finding in examine(data, arm(), repaired=repaired).findings}
    assert {"time-order", "time-double", "order"} <= found


def test_spikes_are_not_taken_for_a_delay(clean):
    (finding,) = quick(spoiled(clean, with_spikes))
    assert (finding.check, finding.joints) == ("spikes", (2,)) and "5 spike" in finding.observation


def test_noise_of_derived_rates_is_not_taken_for_another_unit():
    """A poor cut-off leaves so much noise that the least-squares factor is too small by 15 %."""
    t, q, qd, _ = motions(seed=6)
    noisy = q[0] + [0.1, 0.105, 0.075] * np.random.default_rng(0).normal(size=q[0].shape)
    for factor, words in ((1.0, []), (0.7, ["times dq/dt"]), (180 / np.pi, ["57.3 times"]), (-1.0, ["opposite sign"])):
        data = from_arrays({"t": t, "q": noisy, "qd": factor * qd[0], "trajectory": np.zeros(SAMPLES, int)})
        findings = check_derivatives(data, smooth(data, 7.0, trim=0.0))
        assert all(word in finding.observation for word, finding in zip(words, findings, strict=True))


def test_an_exact_log_of_a_planar_arm_has_no_false_sign_or_delay():
    t, *states = motions(seed=3)
    q, qd, qdd = (x[0] for x in states)
    tau = inverse_dynamics(planar(UPRIGHT, (2.0, 1.0, 0.5)).tree, q, qd, qdd) + 0.2 * qd
    data = from_arrays({"t": t, "q": q, "tau": tau, "trajectory": np.zeros(SAMPLES, int)})
    examined = examine(data)
    assert [finding.check for finding in examined.findings if finding.severity != "note"] == ["split"]
    assert abs(examined.torques.likely_delay) < 0.05
    assert examined.torques.viscous == pytest.approx(np.full(3, 0.2), abs=0.02)
    assert errors({"t": t, "q": q, "qd": qd, "trajectory": np.arange(SAMPLES) // 30}) == [], "short recordings"


def test_covariance_of_torques_is_that_of_an_energy():
    """The closed forms equal derivatives of the energies' covariance by JAX."""
    random, sizes = np.random.default_rng(0), np.array([1.0, 0.4])
    states, others = random.normal(size=(2, 3, 2, 2))
    ranges = np.ptp(states[0], axis=0)

    strengths = np.clip(STRONGEST * np.sqrt(sizes), WEAKEST, STRONGEST)

    def kernel(q, other, power):
        turning = ((1 + strengths[0] * jnp.cos(q[0] - other[0])) / (1 + strengths[0])) ** power
        return turning * jnp.exp(-0.5 * ((q[1] - other[1]) / (2 * ranges[1])) ** 2)

    def torque(energy, q, qd, qdd):
        return jax.jvp(jax.jacfwd(energy, 1), (q, qd), (qd, qdd))[1] - jax.jacfwd(energy)(q, qd)

    def covariance(energy):
        """Returns the covariance [2, 2] of two states' torques; `energy` is that of the energies at both (q, qd)."""
        of_state = lambda *other: torque(lambda *state: energy(*state, *other), *states[:, 0])  # noqa: E731
        return jax.jit(lambda: torque(of_state, *others[:, 1]))()

    kinetic, potential = covariances(tuple(states), tuple(others), ("revolute", "prismatic"), sizes)[0]
    for closed, energy in (
        (kinetic, lambda q, u, p, v: kernel(q, p, 2) * (u * sizes @ v) ** 2),
        (potential, lambda q, u, p, v: kernel(q, p, 1)),
    ):
        assert closed[:2, 2:] == pytest.approx(np.asarray(covariance(energy)), abs=1e-12)


def test_a_repair_is_judged_by_the_joints_that_it_concerns():
    """One joint of seven that is predicted twice as well counts, although the mean over all hardly falls."""
    before = np.full((10, 7), 0.6)
    after = before.copy()
    after[:, 3] = 0.3
    now = Explanation(*5 * [None], np.zeros(10), before)
    other = Explanation(*5 * [None], np.full(10, 4.0), after)
    assert decisive(now, other, 0.8, np.arange(7) == 3)
    assert not decisive(now, other, 0.8, np.arange(7) == 2) and not decisive(now, other, 0.8, np.ones(7, bool))


def test_logs_that_cannot_be_examined_are_refused(clean, tmp_path):
    two = spoiled(clean, lambda a: {"needs": None, **{key: a[key][:, :2] for key in ("q", "qd", "tau")}})
    with one_line("the robot has 3 joints, but the data have 2"):
        examine(two, arm())
    np.savez(tmp_path / "empty.npz", t=np.zeros(3))
    with one_line("key 'q' is missing"):
        read(tmp_path / "empty.npz")


def log(force, pace=1.0):
    """Arrays of a log of two joints, slower by a pace, torques force(q, qd, qdd) and 0.5 % of noise in them."""
    t, *states = motions(seed=4)
    q, qd, qdd = (x.reshape(-1, 3)[:, :2] / pace**k for k, x in enumerate(states))
    tau = force(q, qd, qdd)
    tau = tau + 5e-3 * tau.std(axis=0) * np.random.default_rng(0).normal(size=tau.shape)
    return {"t": np.tile(pace * t, RUNS), "q": q, "tau": tau, "trajectory": np.repeat(np.arange(RUNS), SAMPLES)}


def torques(robot, rotors):
    """Inverse dynamics of a robot with these rotors and viscous friction."""
    tree = robot.tree._replace(armature=np.array(rotors))
    return lambda q, qd, qdd: inverse_dynamics(tree, q, qd, qdd) + 0.1 * qd


def errors(arrays, robot=None):
    findings = quick(from_arrays(arrays), robot)
    return [(finding.check, finding.joints) for finding in findings if finding.severity == "error"]


def test_the_joint_of_a_scara_whose_torque_is_reversed_is_blamed():
    """Turning the other joint's torque explains it as well, with a negative definite inertia."""
    for robot, check in ((planar(LYING), "tree-sign"), (None, "torque-sign")):
        sound = log(torques(planar(LYING), (0.2, 0.1)))
        assert errors(sound, robot) == []
        for joint in (0, 1):
            assert errors({**sound, **of_joint("tau", joint, np.negative)(sound)}, robot) == [(check, (joint,))]


def test_gyroscopic_forces_are_no_exchanged_torques():
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    for force in (
        lambda q, qd, qdd: qdd - qd @ turn + 0.5 * q,
        lambda q, qd, qdd: qdd - 5.0 * qd @ turn + 0.5 * q,
        lambda q, qd, qdd: qdd * [0.2, 0.3] - 4 * qd @ turn + np.sin(q),  # gimbals
    ):
        assert errors(log(force)) == []


def test_rotors_that_a_file_lacks_are_no_gears_and_no_clock():
    robot = planar(UPRIGHT, (3.0, 0.03))
    sound = log(torques(robot, (1.5, 0.2)))
    assert errors(sound, robot) == []
    assert errors({**sound, "tau": 1000 * sound["tau"]}, robot) == [("gear", (0, 1))]  # in millinewtons


def test_torques_without_gravity_are_named_and_fitted_so():
    robot = planar(UPRIGHT)
    data = from_arrays(log(torques(planar((0.0, 0.0, 0.0)), (0.1, 0.1))))
    known = log_of(data, "log.npz", robot=robot, check=True)
    assert any("tau does not include gravity" in line for line in known.remarks)
    assert not any("clock" in line for line in known.remarks) and not any("gravity" in fault for fault in known.faults)
    tree = known.robot.tree
    assert not np.any(tree.gravity) and np.array_equal(tree.inertias, robot.tree.inertias)
    data = from_arrays(log(torques(robot, (0.0, 0.0))))
    assert log_of(data, "log.npz", robot=robot, check=True).robot is robot


def test_torques_late_by_200_ms_are_found_at_20_hz():
    slow = log(lambda q, qd, qdd: np.array([2.0, 1.0]) * qdd + 3 * np.sin(q), pace=5.0)
    findings = quick(from_arrays({**slow, "tau": late(slow["tau"], 4)}))
    (found,) = (finding for finding in findings if finding.check == "delay")
    assert abs(float(found.observation.split()[2]) - 200) < 15


def test_steps_of_a_smooth_extreme_are_not_cut_off():
    t = np.arange(2000) / 200
    torque = 5 * np.sin(3 * t)
    for values, step, cut in (
        (np.sin(2 * t), 2 * np.pi / 4096, False),
        (torque, 0.5, False),
        (4 * np.sin(12 * t + 0.03), 0.05, False),
        (np.clip(torque, -3.0, 3.0), 0.01, True),
    ):
        rounded = np.round(values / step) * step
        assert (flat_share(rounded, np.zeros(2000, int), step_of(rounded[:, None])[0]) > 0.1) == cut
