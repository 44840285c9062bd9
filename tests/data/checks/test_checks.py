"""Every check finds the fault that is planted, names its joint, and is silent on data without it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.cli.encoders import FILTERED
from dln_jax.data import schema
from dln_jax.data.checks import as_recording, examine, quick, read, report
from dln_jax.data.checks.derivatives import at_times_of, check_derivatives, match
from dln_jax.data.checks.energies import OF_BODY, STRONGEST, WEAKEST, covariances
from dln_jax.data.checks.evidence import Explanation
from dln_jax.data.checks.hypotheses import decisive
from dln_jax.data.encoders.smoothing import smooth
from dln_jax.data.robots import Robot
from dln_jax.mechanics import trees
from dln_jax.mechanics.equations import dynamics
from dln_jax.scenes.datasets import generators
from dln_jax.scenes.pendulums import two_link_arm
from dln_jax.scenes.poles import cart_pole
from dln_jax.types import Needs
from tests.calls import one_line
from tests.motions import sums_of_sines

RATE, SAMPLES, RUNS = 100.0, 700, 4
NOISE_TAU = np.array([0.15, 0.1, 0.02])
RIGHT = np.pi / 2
WIDE = np.tile([-np.inf, np.inf], (3, 1))


def arm(gravity=(0.0, 0.0, -9.81)):
    """Three joints: a vertical one, then two across it."""
    rows = [[0, 0, 0.3, 0], [-RIGHT, 0.05, 0, -RIGHT], [0, 0.4, 0, 0]]
    links = [
        trees.inertial_parameters(mass, centre, size * np.eye(3))
        for mass, centre, size in ((3.0, [0, 0, -0.1], 0.02), (2.5, [0.2, 0, 0], 0.03), (1.0, [0.15, 0.02, 0], 0.01))
    ]
    tree = trees.serial(*trees.dh_frames(rows), links, armature=np.array([0.1, 0.1, 0.02]), gravity=gravity)
    return Robot(tree._replace(names=("base", "shoulder", "elbow")), np.zeros(3), np.zeros(3), WIDE, WIDE)


def motions(seed):
    """t, and q, qd and qdd [RUNS, SAMPLES, 3] of sums of sines."""
    random = np.random.default_rng(seed)
    t = np.arange(SAMPLES) / RATE
    rates = 2 * np.pi * np.array([0.15, 0.4, 0.7, 1.1])
    sizes = np.array([1.0, 0.7, 0.4, 0.25]) * random.uniform(0.4, 1.2, (RUNS, 3, 4))
    phases = random.uniform(0, 2 * np.pi, (RUNS, 3, 4))
    runs = [sums_of_sines(t, size, rates, phase) for size, phase in zip(sizes, phases, strict=True)]
    return t, *np.stack(runs, axis=1)


def inverse_dynamics(tree, *states):
    return np.asarray(jax.jit(jax.vmap(lambda *state: trees.newton_euler(tree, *state)))(*states))


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
        "tau": tau + NOISE_TAU * random.normal(size=tau.shape),
        "trajectory": np.repeat(np.arange(RUNS), SAMPLES),
        "needs": np.array('{"joints": ["revolute", "revolute", "revolute"], "friction": true}'),
    }


def spoiled(arrays, plant):
    """The trajectories of a log with a planted fault; `None` takes a key away."""
    given = {**arrays, **plant(arrays)}
    return schema.from_arrays({key: value for key, value in given.items() if value is not None})


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
LOG_FAULTS = {
    "q in degrees": (lambda a: {"q": np.degrees(a["q"])}, "qd-unit", (0, 1, 2), "q from degrees"),
    "all in degrees": (lambda a: {"q": np.degrees(a["q"]), **RATELESS}, "q-unit", None, "degrees"),
    "q of a motor": (lambda a: {**of_joint("q", 1, lambda x: 80 * x)(a), **RATELESS}, "q-unit", (1,), "gear"),
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
    "still": (of_joint("q", 2, np.ones_like), "unexcited", (2,), "never moves"),
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
}  # fmt: skip


def test_nothing_is_found_in_clean_logs(clean):
    assert quick(schema.from_arrays(clean)) == []
    assert quick(spoiled(clean, lambda a: {"q": motions(seed=1)[1].reshape(-1, 3), **RATELESS})) == []
    assert quick(generators.uniform(cart_pole(), samples=200)) == []
    assert quick(generators.characters()) == []


def test_nothing_is_found_in_an_exact_log_of_two_links(clean):
    scene = two_link_arm()
    q, qd, qdd = (x.reshape(-1, 3)[:, :2] for x in motions(seed=3)[1:])
    tau = jax.jit(jax.vmap(dynamics(scene.closed_form).inverse_dynamics))(q, qd, qdd)
    data = spoiled(clean, lambda a: {"needs": None, "q": q, "qd": qd, "qdd": qdd, "tau": np.asarray(tau)})
    assert quick(data._replace(needs=scene.needs)) == []


@pytest.mark.parametrize("name", LOG_FAULTS)
def test_a_planted_fault_is_found(clean, name):
    plant, check, joints, word = LOG_FAULTS[name]
    findings = quick(spoiled(clean, plant))
    found = [finding for finding in findings if finding.check == check]
    assert found, f"{check} is not among {[finding.line for finding in findings]}"
    assert word in found[0].line and "\n" not in found[0].line and found[0].remedy
    assert joints is None or found[0].joints == joints


TREE_FAULTS = {
    "motor's torque": (lambda a: {"tau": a["tau"] / 100}, arm(), "gear", (0, 1, 2)),
    "columns exchanged": (lambda a: {key: a[key][:, [0, 2, 1]] for key in ("q", "qd", "tau")}, arm(), "order", ()),
    "upside down": (lambda a: {}, arm(gravity=(0.0, 0.0, 9.81)), "gravity", ()),
    "torques late": (lambda a: {"tau": late(a["tau"], 2)}, arm(), "delay", ()),
    "beyond limits": (
        lambda a: {}, arm()._replace(position_limits=np.tile([-0.5, 0.5], (3, 1))), "limits", (0, 1, 2)
    ),
    "dead torque": (of_joint("tau", 1, np.zeros_like), arm(), "dead-torque", (1,)),  # which overflowed once
}  # fmt: skip


@pytest.mark.parametrize("name", TREE_FAULTS)
def test_a_fault_against_the_robot_is_found(clean, name):
    plant, robot, check, joints = TREE_FAULTS[name]
    examined = examine(as_recording(spoiled(clean, plant)), robot)
    found = [finding for finding in examined.findings if finding.check == check]
    assert found, f"{check} is not among {[finding.line for finding in examined.findings]}"
    assert found[0].joints == joints and "\n" not in found[0].line
    if name == "upside down":
        assert "-9." in found[0].observation
    if name == "torques late":
        assert examined.on_tree.torques.log.delay == pytest.approx(2, abs=0.3)


def test_a_clean_log_suits_its_robot(clean):
    examined = examine(as_recording(schema.from_arrays(clean)), arm())
    on_tree = examined.on_tree
    assert examined.findings == [] and "nothing was found" in report(examined, "log.npz")
    assert on_tree.scale == pytest.approx(np.ones(3), rel=0.1)
    assert on_tree.gravity == pytest.approx([0, 0, -9.81], abs=0.3)
    assert abs(on_tree.torques.likely_delay) < 0.2
    assert on_tree.torques.coulomb == pytest.approx([0.8, 0.8, 0.15], rel=0.15)
    assert 0 < on_tree.rank < on_tree.parameters and 1 < on_tree.condition < 1000


def test_rough_masses_of_a_file_are_no_fault_of_the_log(clean):
    rough = arm()
    rough = rough._replace(tree=rough.tree._replace(inertias=np.array([[1.3], [0.7], [1.2]]) * rough.tree.inertias))
    assert [each for each in quick(spoiled(clean, lambda a: RATELESS), rough) if each.severity == "error"] == []


def test_a_tilt_and_a_wrong_clock_are_found_with_the_robot(clean):
    tilted = arm(gravity=(9.81 * np.sin(0.3), 0.0, -9.81 * np.cos(0.3)))
    (finding,) = examine(as_recording(schema.from_arrays(clean)), tilted).on_tree.findings
    assert finding.check == "gravity" and "17 degrees" in finding.observation
    examined = examine(as_recording(spoiled(clean, lambda a: {"t": 1.25 * a["t"], **RATELESS})), arm())
    # A filter settles no error of the clock.
    errors = {finding.check for finding in examined.findings if finding.severity == "error"}
    assert errors == {"clock"} and not errors & {*FILTERED} and "arrival" in FILTERED
    assert examined.on_tree.torques.log.speed == pytest.approx(1.25, rel=0.03)


def test_times_out_of_order_or_double_are_repaired_and_said(clean, tmp_path):
    order = np.random.default_rng(0).permutation(len(clean["t"]))
    order = np.r_[order, order[:5]]
    arrays = {key: x if key == "needs" else x[order] for key, x in clean.items()}
    np.savez(tmp_path / "log.npz", **arrays, joint_names=np.array(["elbow", "base", "shoulder"]))
    recording = read(tmp_path / "log.npz")
    assert [finding.check for finding in recording.repaired] == ["time-order", "time-double"]
    assert np.array_equal(recording.data.q, clean["q"])
    assert recording.data.needs == Needs(("revolute",) * 3, friction=True)
    findings = examine(recording, arm()).findings
    assert {"time-order", "time-double", "order"} <= {finding.check for finding in findings}


def test_spikes_are_not_taken_for_a_delay(clean):
    (finding,) = quick(spoiled(clean, with_spikes))
    assert (finding.check, finding.joints) == ("spikes", (2,)) and "5 spike" in finding.observation


def test_noise_of_derived_rates_is_not_taken_for_another_unit():
    """A poor cut-off leaves so much noise that the least-squares factor is too small by 15 %."""
    t, q, qd, _ = motions(seed=6)
    noisy = q[0] + [0.1, 0.105, 0.075] * np.random.default_rng(0).normal(size=q[0].shape)
    for factor, words in ((1.0, None), (0.7, "times dq/dt"), (180 / np.pi, "57.3 times"), (-1.0, "opposite sign")):
        data = schema.from_arrays({"t": t, "q": noisy, "qd": factor * qd[0], "trajectory": np.zeros(SAMPLES, int)})
        even = smooth(data, 7.0, trim=0.0)
        least = match(at_times_of(data, even, data.qd), even.data.qd, even.data.trajectory, 25).factor
        assert np.all(least / factor < 1 / 1.15) and np.all(least / factor > 0.8)
        findings = check_derivatives(data, even)
        assert len(findings) == (words is not None)
        assert words is None or words in findings[0].observation


def test_an_exact_log_of_a_planar_arm_has_no_false_sign_or_delay():
    t, *states = motions(seed=3)
    q, qd, qdd = (x[0] for x in states)
    links = [trees.inertial_parameters(m, [0.2, 0, 0], 0.02 * np.eye(3)) for m in (2.0, 1.0, 0.5)]
    frames = trees.dh_frames([[0, 0.4 * (k > 0), 0, 0] for k in range(3)])
    tau = inverse_dynamics(trees.serial(*frames, links, gravity=(0.0, -9.81, 0.0)), q, qd, qdd) + 0.2 * qd
    data = schema.from_arrays({"t": t, "q": q, "tau": tau, "trajectory": np.zeros(SAMPLES, int)})
    examined = examine(as_recording(data))
    assert [finding.check for finding in examined.findings if finding.severity != "note"] == ["split"]
    assert abs(examined.regression.likely_delay) < 0.05
    assert examined.regression.viscous == pytest.approx(np.full(3, 0.2), abs=0.02)


def test_covariance_of_torques_is_that_of_an_energy():
    """The closed forms equal derivatives of the energies' covariance by JAX: of any energy, then of two bodies.

    The first body is moved by the first joint alone; no kinetic energy of a body depends on the first joint's angle.
    """
    random, sizes = np.random.default_rng(0), np.array([1.0, 0.4])
    states, others = random.normal(size=(2, 3, 2, 2))
    ranges = np.ptp(states[0], axis=0)

    def kernel(q, other, strength, power):
        turning = ((1 + strength[0] * jnp.cos(q[0] - other[0])) / (1 + strength[0])) ** power
        sliding = jnp.exp(-0.5 * ((q[1] - other[1]) / (2 * ranges[1])) ** 2)
        return turning * jnp.where(strength[1] > 0, sliding, 1.0)

    def torque(energy, q, qd, qdd):
        return jax.jvp(jax.grad(energy, 1), (q, qd), (qd, qdd))[1] - jax.grad(energy)(q, qd)

    def both(state, other, kinetic_strength, potential_strength, weights):
        """Covariances of the kinetic and the potential torques [2, 2] of two states."""

        def by_state(p, v):
            return torque(lambda q, u: kernel(q, p, kinetic_strength, 2) * (u * weights @ v) ** 2, *state)

        kinetic = jnp.stack([torque(lambda p, v, i=i: by_state(p, v)[i], *other) for i in range(2)])
        return kinetic, jax.jacfwd(jax.grad(lambda q, p: kernel(q, p, potential_strength, 1)), 1)(state[0], other[0])

    pairs = jax.vmap(jax.vmap(both, (None, 1, None, None, None)), (1, None, None, None, None))
    of_any = np.clip(STRONGEST * np.sqrt(sizes), WEAKEST, STRONGEST)
    first, second = np.eye(2)
    priors = (
        (of_any, of_any, sizes),
        (0 * first, OF_BODY * first, 0.7 * first),
        (OF_BODY * second, OF_BODY * np.ones(2), 0.7 * np.ones(2)),
    )
    compiled = jax.jit(pairs)
    found = covariances(tuple(states), tuple(others), ("revolute", "prismatic"), sizes)
    for ours, prior in zip(found, priors, strict=True):
        for closed, blocks in zip((ours.kinetic, ours.potential), compiled(states, others, *prior), strict=True):
            assert closed == pytest.approx(np.asarray(blocks).swapaxes(1, 2).reshape(4, 4), abs=1e-12)


def test_a_repair_is_judged_by_the_joints_that_it_concerns():
    """One joint of seven that is predicted twice as well counts, although the mean over all hardly falls."""
    before = np.full((10, 7), 0.6)
    after = before.copy()
    after[:, 3] = 0.3
    now = Explanation(None, None, None, np.zeros(10), before)
    other = Explanation(None, None, None, np.full(10, 4.0), after)
    assert decisive(now, other, 0.8, np.arange(7) == 3)
    assert not decisive(now, other, 0.8, np.arange(7) == 2) and not decisive(now, other, 0.8, np.ones(7, bool))


def test_logs_that_cannot_be_examined_are_refused(clean, tmp_path):
    two = spoiled(clean, lambda a: {"needs": None, **{key: a[key][:, :2] for key in ("q", "qd", "tau")}})
    with one_line("the robot has 3 joints, but the data have 2"):
        examine(as_recording(two), arm())
    np.savez(tmp_path / "empty.npz", t=np.zeros(3))
    with one_line("key 'q' is missing"):
        read(tmp_path / "empty.npz")
