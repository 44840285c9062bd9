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
from dln_jax.types import InputError, Needs

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
    """q, qd and qdd [RUNS, SAMPLES, 3] of sums of sines."""
    random = np.random.default_rng(seed)
    t = np.arange(SAMPLES) / RATE
    w = 2 * np.pi * np.array([0.15, 0.4, 0.7, 1.1])
    a, b = random.uniform(-1, 1, (2, RUNS, 3, 4)) * np.array([1.0, 0.7, 0.4, 0.25])
    sine, cosine = np.sin(w[:, None] * t), np.cos(w[:, None] * t)

    def total(first, second):
        return np.moveaxis(first @ sine + second @ cosine, 1, 2)

    return t, total(a, b), total(-b * w, a * w), total(-a * w**2, -b * w**2)


@pytest.fixture(scope="module")
def clean():
    """Arrays of a log of the arm with friction, its encoders' and torques' noise, and true rates."""
    t, q, qd, qdd = motions(seed=1)
    tree = arm().tree
    flat = [x.reshape(-1, 3) for x in (q, qd, qdd)]
    tau = np.asarray(jax.jit(jax.vmap(lambda *state: trees.newton_euler(tree, *state)))(*flat))
    tau = tau + flat[1] * [0.4, 0.4, 0.1] + np.tanh(flat[1] / 0.02) * [0.8, 0.8, 0.15]
    random = np.random.default_rng(2)
    return {
        "t": np.tile(t, RUNS),
        "q": flat[0] + 2e-5 * random.normal(size=flat[0].shape),
        "qd": flat[1],
        "tau": tau + NOISE_TAU * random.normal(size=tau.shape),
        "trajectory": np.repeat(np.arange(RUNS), SAMPLES),
        "needs": np.array('{"joints": ["revolute", "revolute", "revolute"], "friction": true}'),
    }


def column(array, joint, change):
    changed = array.copy()
    changed[:, joint] = change(changed[:, joint])
    return changed


def late(array, samples):
    """Each run so many samples later; its first value is repeated."""
    runs = array.reshape(RUNS, SAMPLES, -1)
    return np.concatenate([np.repeat(runs[:, :1], samples, 1), runs[:, :-samples]], 1).reshape(array.shape)


def without(keys, arrays):
    return {key: value for key, value in arrays.items() if key not in keys}


def silent(arrays):
    """Without torques, which take most of the time to check and have no part in faults of t and q."""
    return without(["tau"], arrays)


def shuffled(arrays):
    order = np.random.default_rng(0).permutation(len(arrays["t"]))
    return {key: value if key == "needs" else value[order] for key, value in arrays.items()}


def jittered(arrays):
    return silent({**arrays, "t": arrays["t"] + np.random.default_rng(0).uniform(0, 0.003, len(arrays["t"]))})


def with_gap(arrays):
    kept = np.ones(len(arrays["t"]), bool)
    kept[200:300] = False
    return silent({key: value if key == "needs" else value[kept] for key, value in arrays.items()})


def one_run(arrays):
    kept = arrays["trajectory"] == 0
    return silent({key: value if key == "needs" else value[kept] for key, value in arrays.items()})


def with_spikes(arrays):
    tau = arrays["tau"].copy()
    tau[100::500, 2] += 5 * tau[:, 2].std()
    return {**arrays, "tau": tau[: len(arrays["t"])]}


def with_repeats(arrays):
    rows = np.arange(100, len(arrays["t"]) - 5, 101)
    changed = {key: arrays[key].copy() for key in ("q", "qd", "tau")}
    for values in changed.values():
        values[rows] = values[rows - 1]
    return {**arrays, **changed}


LOG_FAULTS = {
    "degrees per second": (lambda a: {**a, "qd": np.degrees(a["qd"])}, "qd-unit", (0, 1, 2), "degrees"),
    "q in degrees": (lambda a: {**a, "q": np.degrees(a["q"])}, "qd-unit", (0, 1, 2), "q from degrees"),
    "all in degrees": (lambda a: without(["qd"], {**a, "q": np.degrees(a["q"])}), "q-unit", None, "degrees"),
    "q of a motor": (
        lambda a: without(["qd"], {**a, "q": column(a["q"], 1, lambda x: 80 * x)}), "q-unit", (1,), "gear"
    ),
    "qd turned round": (lambda a: {**a, "qd": column(a["qd"], 2, np.negative)}, "qd-sign", (2,), "sign"),
    "qd of a motor": (lambda a: {**a, "qd": column(a["qd"], 1, lambda x: 50 * x)}, "qd-unit", (1,), "50"),
    "qd late": (lambda a: silent({**a, "qd": late(a["qd"], 3)}), "qd-delay", (0, 1, 2), "30 ms late"),
    "qd exchanged": (lambda a: {**a, "qd": a["qd"][:, [1, 0, 2]]}, "qd-unlike", (0, 1), "order"),
    "milliseconds": (lambda a: {**a, "t": 1000 * a["t"]}, "time-unit", (), "seconds"),
    "jitter": (lambda a: without(["qd"], jittered(a)), "jitter", (), "vary by"),
    "stamps of arrival": (jittered, "arrival", (), "whole multiples of 10 ms"),
    "gap": (with_gap, "gaps", (), "1 gap"),
    "one run": (one_run, "split", (), "trajectories is 1"),
    "torque turned round": (lambda a: {**a, "tau": column(a["tau"], 1, np.negative)}, "torque-sign", (1,), "sign"),
    "torques late": (lambda a: {**a, "tau": late(a["tau"], 8)}, "delay", (), "late"),
    "torques cut off": (lambda a: {**a, "tau": np.clip(a["tau"], -6, 6)}, "saturation-tau", None, "cut off"),
    "q cut off": (
        lambda a: {**a, "q": column(a["q"], 2, lambda x: np.minimum(x, 0.6 * x.max()))}, "saturation-q", (2,), "flat"
    ),
    "still": (lambda a: {**a, "q": column(a["q"], 2, lambda x: 0 * x + 1)}, "unexcited", (2,), "never moves"),
    "hardly moved": (lambda a: {**a, "q": column(a["q"], 2, lambda x: 0.001 * x)}, "unexcited", (2,), "less than"),
    "steps": (lambda a: silent({**a, "q": np.round(a["q"] / 2e-3) * 2e-3}), "quantisation", (0, 1, 2), "up to 0.002"),
    "raw differences": (
        lambda a: without(["qd"], silent({**a, "q": a["q"] + 3e-4 * np.random.default_rng(0).normal(size=(2800, 3))})),
        *("raw-differences", (), "--cutoff auto"),
    ),
    "constant torque": (
        lambda a: {**a, "tau": column(a["tau"], 0, lambda x: 0 * x + 2)}, "constant-torque", (0,), "constant"
    ),
    "torques exchanged": (lambda a: {**a, "tau": a["tau"][:, [0, 2, 1]]}, "order", (1, 2), "1, 3, 2"),
    "dead torque": (lambda a: {**a, "tau": column(a["tau"], 1, np.zeros_like)}, "dead-torque", (1,), "zero"),
    "small torques hidden": (
        lambda a: {**a, "tau": column(a["tau"], 2, lambda x: np.where(np.abs(x) > np.quantile(np.abs(x), 0.7), x, 0))},
        *("hidden-torque", (2,), "exactly zero in up to"),
    ),
    "all torques dead": (lambda a: {**a, "tau": 0 * a["tau"]}, "dead-torque", (0, 1, 2), "zero"),
    "qd and qdd exchanged": (
        lambda a: {**a, "qd": motions(seed=1)[3].reshape(-1, 3), "qdd": a["qd"]}, "qd-exchanged", (), "exchange"
    ),
    "spikes": (with_spikes, "spikes", (2,), "5 spike"),
    "repeated rows": (with_repeats, "repeated", (), "27 of rows"),
    "friction not stated": (lambda a: without(["needs"], a), "friction", None, "friction is seen"),
}  # fmt: skip


def test_nothing_is_found_in_a_clean_log(clean):
    assert quick(schema.from_arrays(clean)) == []
    exact = schema.from_arrays(without(["qd"], {**clean, "q": motions(seed=1)[1].reshape(-1, 3)}))
    assert quick(exact) == []


@pytest.mark.parametrize("seed", [3, 5])
def test_nothing_is_found_in_other_clean_logs(seed):
    t, q, qd, qdd = motions(seed)
    scene = two_link_arm()
    data = schema.from_arrays(
        {
            "t": np.tile(t, RUNS),
            **{key: x.reshape(-1, 3)[:, :2] for key, x in (("q", q), ("qd", qd), ("qdd", qdd))},
            "trajectory": np.repeat(np.arange(RUNS), SAMPLES),
        }
    )
    tau = jax.jit(jax.vmap(dynamics(scene.closed_form).inverse_dynamics))(data.q, data.qd, data.qdd)
    assert quick(data._replace(tau=np.asarray(tau), estimated=(), needs=scene.needs)) == []


def test_nothing_is_found_in_generated_data():
    assert quick(generators.uniform(cart_pole(), samples=200)) == []
    assert quick(generators.characters()) == []


@pytest.mark.parametrize("name", LOG_FAULTS)
def test_a_planted_fault_is_found(clean, name):
    plant, check, joints, word = LOG_FAULTS[name]
    findings = quick(schema.from_arrays(plant(dict(clean))))
    found = [finding for finding in findings if finding.check == check]
    assert found, f"{check} is not among {[finding.line for finding in findings]}"
    assert word in found[0].line and "\n" not in found[0].line and found[0].remedy
    if joints is not None:
        assert found[0].joints == joints


TREE_FAULTS = {
    "torque turned round": (lambda a: {**a, "tau": column(a["tau"], 2, np.negative)}, arm(), "tree-sign", (2,)),
    "motor's torque": (lambda a: {**a, "tau": a["tau"] / 100}, arm(), "gear", (0, 1, 2)),
    "columns exchanged": (
        lambda a: {**a, **{key: a[key][:, [0, 2, 1]] for key in ("q", "qd", "tau")}}, arm(), "order", ()
    ),
    "upside down": (dict, arm(gravity=(0.0, 0.0, 9.81)), "gravity", ()),
    "on a wall": (dict, arm(gravity=(0.0, 9.81, 0.0)), "gravity", ()),
    "torques late": (lambda a: {**a, "tau": late(a["tau"], 2)}, arm(), "delay", ()),
    "beyond limits": (dict, arm()._replace(position_limits=np.tile([-0.5, 0.5], (3, 1))), "limits", (0, 1, 2)),
}  # fmt: skip


@pytest.mark.slow
def test_a_clean_log_suits_its_robot(clean):
    examined = examine(as_recording(schema.from_arrays(clean)), arm())
    on_tree = examined.on_tree
    assert examined.findings == []
    assert on_tree.scale == pytest.approx(np.ones(3), rel=0.1)
    assert on_tree.gravity == pytest.approx([0, 0, -9.81], abs=0.3)
    assert abs(on_tree.torques.likely_delay) < 0.2
    assert on_tree.torques.coulomb == pytest.approx([0.8, 0.8, 0.15], rel=0.15)
    assert 0 < on_tree.rank < on_tree.parameters and 1 < on_tree.condition < 1000
    assert "nothing was found" in report(examined, "log.npz")


@pytest.mark.parametrize("name", TREE_FAULTS)
def test_a_fault_against_the_robot_is_found(clean, name):
    plant, robot, check, joints = TREE_FAULTS[name]
    examined = examine(as_recording(schema.from_arrays(plant(dict(clean)))), robot)
    findings = examined.findings
    found = [finding for finding in findings if finding.check == check]
    assert found, f"{check} is not among {[finding.line for finding in findings]}"
    assert found[0].joints == joints and "\n" not in found[0].line
    if name == "upside down":
        assert "-9." in found[0].observation
    if name == "torques late":
        assert examined.on_tree.torques.log.delay == pytest.approx(2, abs=0.3)


def test_a_robot_of_another_size_is_refused(clean):
    with pytest.raises(InputError, match="the robot has 3 joints, but the data have 2"):
        examine(
            as_recording(
                schema.from_arrays({**without(["needs"], clean), **{k: clean[k][:, :2] for k in ("q", "qd", "tau")}})
            ),
            arm(),
        )


def test_times_out_of_order_or_double_are_repaired_and_said(clean, tmp_path):
    arrays = shuffled(clean)
    arrays = {key: x if key == "needs" else np.concatenate([x, x[:5]]) for key, x in arrays.items()}
    np.savez(tmp_path / "log.npz", **arrays, joint_names=np.array(["elbow", "base", "shoulder"]))
    recording = read(tmp_path / "log.npz")
    assert [finding.check for finding in recording.repaired] == ["time-order", "time-double"]
    assert np.array_equal(recording.data.q, clean["q"]) and recording.data.needs == Needs(
        ("revolute",) * 3, friction=True
    )
    findings = examine(recording, arm()).findings
    assert {"time-order", "time-double", "order"} <= {finding.check for finding in findings}


def test_spikes_are_not_taken_for_a_delay(clean):
    checks = {finding.check for finding in quick(schema.from_arrays(with_spikes(clean)))}
    assert checks == {"spikes"}


@pytest.mark.parametrize("factor", [1.0, 0.7, 180 / np.pi, -1.0])
def test_noise_of_derived_rates_is_not_taken_for_another_unit(factor):
    """A poor cut-off leaves so much noise that the least-squares factor is too small by 15 %."""
    t, q, qd, _ = motions(seed=6)
    noisy = q[0] + 0.095 * np.random.default_rng(0).normal(size=q[0].shape)
    data = schema.from_arrays({"t": t, "q": noisy, "qd": factor * qd[0], "trajectory": np.zeros(SAMPLES, int)})
    even = smooth(data, 7.0, trim=0.0)
    least = match(at_times_of(data, even, data.qd), even.data.qd, even.data.trajectory, 25).factor
    assert np.all(least / factor < 1 / 1.15) and np.all(least / factor > 0.8)
    words = {1.0: [], 0.7: ["times dq/dt"], -1.0: ["opposite sign"]}.get(factor, ["57.3 times"])
    findings = check_derivatives(data, even)
    assert len(findings) == len(words) and all(word in findings[0].observation for word in words)


@pytest.mark.parametrize("seed", [3, 4])
def test_exact_logs_of_planar_arms_have_no_false_sign_or_delay(seed):
    t, q, qd, qdd = motions(seed)
    links = [trees.inertial_parameters(m, [0.2, 0, 0], 0.02 * np.eye(3)) for m in (2.0, 1.0, 0.5)]
    frames = trees.dh_frames([[0, 0.4 * (k > 0), 0, 0] for k in range(3)])
    tree = trees.serial(*frames, links, gravity=(0.0, -9.81, 0.0))
    states = [x[0] for x in (q, qd, qdd)]
    tau = np.asarray(jax.jit(jax.vmap(lambda *state: trees.newton_euler(tree, *state)))(*states)) + 0.2 * states[1]
    data = schema.from_arrays({"t": t, "q": states[0], "tau": tau, "trajectory": np.zeros(SAMPLES, int)})
    examined = examine(as_recording(data))
    assert [finding.check for finding in examined.findings if finding.severity != "note"] == ["split"]
    assert abs(examined.regression.likely_delay) < 0.05
    assert examined.regression.viscous == pytest.approx(np.full(3, 0.2), abs=0.02)


def test_a_tilt_and_a_wrong_clock_are_found_with_the_robot(clean):
    tilted = arm(gravity=(9.81 * np.sin(0.3), 0.0, -9.81 * np.cos(0.3)))
    on_tree = examine(as_recording(schema.from_arrays(clean)), tilted).on_tree
    assert [finding.check for finding in on_tree.findings] == ["gravity"]
    assert "17 degrees" in on_tree.findings[0].observation
    slow = without(["qd"], {**clean, "t": 1.25 * clean["t"]})
    on_tree = examine(as_recording(schema.from_arrays(slow)), arm()).on_tree
    assert [finding.check for finding in on_tree.findings] == ["clock"]
    assert on_tree.torques.log.speed == pytest.approx(1.25, rel=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("place", [0, 1, 2])
def test_covariance_of_torques_is_that_of_an_energy(place):
    """The closed forms equal derivatives of the energies' covariance by JAX: of any energy, then of two bodies.

    The first body is moved by the first joint alone; no kinetic energy of a body depends on the first joint's angle.
    """
    random, joints, sizes = np.random.default_rng(0), ("revolute", "prismatic"), np.array([1.0, 0.4])
    states, others = (tuple(random.normal(size=(2, 2)) for _ in range(3)) for _ in range(2))
    found = covariances(states, others, joints, sizes)[place]
    of_any = np.clip(STRONGEST * np.sqrt(sizes), WEAKEST, STRONGEST)
    kinetic_strength, potential_strength, weights = (
        (of_any, of_any, sizes),
        (np.zeros(2), OF_BODY * np.array([1.0, 0.0]), 0.7 * np.array([1.0, 0.0])),
        (OF_BODY * np.array([0.0, 1.0]), OF_BODY * np.ones(2), 0.7 * np.ones(2)),
    )[place]
    ranges = np.ptp(states[0], axis=0)

    def kernel(q, other, strength, power):
        turning = ((1 + strength[0] * jnp.cos(q[0] - other[0])) / (1 + strength[0])) ** power
        return turning * (jnp.exp(-0.5 * ((q[1] - other[1]) / (2 * ranges[1])) ** 2) if strength[1] else 1.0)

    def torque(energy, q, qd, qdd):
        return jax.jvp(jax.grad(energy, 1), (q, qd), (qd, qdd))[1] - jax.grad(energy)(q, qd)

    def kinetic(state, other):
        def by_state(p, v):
            return torque(lambda q, u: kernel(q, p, kinetic_strength, 2) * (u * weights @ v) ** 2, *state)

        return jnp.stack([torque(lambda p, v, i=i: by_state(p, v)[i], *other) for i in range(2)])

    def potential(q, p):
        return kernel(q, p, potential_strength, 1)

    with jax.enable_x64(True):
        for a in range(2):
            for b in range(2):
                state, other = ([jnp.asarray(x[k]) for x in xs] for xs, k in ((states, a), (others, b)))
                block = (slice(2 * a, 2 * a + 2), slice(2 * b, 2 * b + 2))
                assert found.kinetic[block] == pytest.approx(np.asarray(kinetic(state, other)), abs=1e-12)
                expected = jax.jacfwd(jax.grad(potential), 1)(state[0], other[0])
                assert found.potential[block] == pytest.approx(np.asarray(expected), abs=1e-12)


def test_a_repair_is_judged_by_the_joints_that_it_concerns():
    """One joint of seven that is predicted twice as well counts, although the mean over all hardly falls."""
    before = np.full((10, 7), 0.6)
    after = before.copy()
    after[:, 3] = 0.3
    now, other = (
        Explanation(None, None, None, each, share)
        for each, share in ((np.zeros(10), before), (np.full(10, 4.0), after))
    )
    assert decisive(now, other, 0.8, np.arange(7) == 3)
    assert not decisive(now, other, 0.8, np.arange(7) == 2) and not decisive(now, other, 0.8, np.ones(7, bool))


def test_a_channel_that_is_dead_is_found_with_the_robot(clean):
    """Its torque does not vary: no number may overflow."""
    data = schema.from_arrays({**clean, "tau": column(clean["tau"], 1, np.zeros_like)})
    assert any(1 in each.joints for each in quick(data, arm()) if each.severity != "note")


def test_quick_checks_use_the_robot_where_there_is_one(clean):
    """A base that is tilted is seen by the robot's file only; rough masses in it are no fault of the log."""
    data = schema.from_arrays(without(["qd"], clean))
    tilted = arm(gravity=(0.0, 9.81 * np.sin(0.4), -9.81 * np.cos(0.4)))
    assert [each.check for each in quick(data, tilted) if each.severity == "error"] == ["gravity"]
    rough = arm()
    rough = rough._replace(tree=rough.tree._replace(inertias=np.array([[1.3], [0.7], [1.2]]) * rough.tree.inertias))
    assert [each for each in quick(data, rough) if each.severity == "error"] == []


def test_a_file_that_is_none_is_refused(tmp_path):
    (tmp_path / "log.npz").write_text("no archive")
    with pytest.raises(InputError, match="not a readable npz"):
        read(tmp_path / "log.npz")
    np.savez(tmp_path / "empty.npz", t=np.zeros(3))
    with pytest.raises(InputError, match="key 'q' is missing"):
        read(tmp_path / "empty.npz")


def test_a_cut_off_settles_no_error_of_the_times(clean):
    """Filters repair stamps of arrival, and leave a log whose clock runs at another rate wrong."""
    settled = {finding.check for finding in quick(schema.from_arrays(jittered(dict(clean))))} & {*FILTERED}
    assert settled == {"arrival"}
    slow = schema.from_arrays(without(["qd"], {**clean, "t": 1.25 * clean["t"]}))
    errors = {finding.check for finding in quick(slow, arm()) if finding.severity == "error"}
    assert errors == {"clock"} and not errors & {*FILTERED}
