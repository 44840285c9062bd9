"""Exported C equals JAX on random states, compiles without warnings, and runs clean under the sanitizers."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.command_line.running import run
from dln_jax.commands import export_c as script
from dln_jax.deploy.c import interface as c_interface
from dln_jax.deploy.c.load import FLAGS, CDynamics, CFunction, CPlainDynamics, compile_c, load_c
from dln_jax.deploy.c.source import export_c, source_files
from dln_jax.deploy.exports import described, read_export, write_exports
from dln_jax.mechanics.dynamics import Dynamics
from dln_jax.mechanics.equations import dynamics, hamiltonian_of
from dln_jax.nn import activations, differential_mlp
from dln_jax.types import InputError, Needs
from dln_jax.zoo.descriptions import build, describe
from dln_jax.zoo.run import save

STATES = 1000
KEY = jax.random.key(0)
STRICT = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-Wshadow", "-Wdouble-promotion")
BOUND = {"f64": 1e-12, "f32": 1e-5}
needs_compiler = pytest.mark.skipif(
    not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="there is no C compiler on the PATH"
)

NETWORK = {"width": 5, "depth": 2, "activation": "tanh"}
CONVEX = {"width": 8, "depth": 2, "activation": "softplus"}
SWING, MIXED, ARM = ["revolute"], ["prismatic", "revolute"], ["revolute", "prismatic", "revolute"]
# kind, joints, gravity, friction, keywords
CASES = {
    "delan-1": ("structured-delan", SWING, True, True, {**NETWORK, "depth": 3}),
    "delan-2-shared": ("structured-delan", MIXED, True, False, {**NETWORK, "shared_trunk": True, "width": 16}),
    "delan-3-no-gravity": ("structured-delan", ARM, False, True, {**NETWORK, "activation": "silu", "depth": 1}),
    "hnn-1": ("structured-hnn", ["prismatic"], True, False, NETWORK),
    "hnn-2": ("structured-hnn", MIXED, True, True, {**NETWORK, "diagonal_shift": 0.5, "diagonal_floor": 0.2}),
    "trigonometric-1": ("trigonometric", SWING, True, False, {"degree": 1}),
    "trigonometric-2": ("trigonometric", MIXED, True, True, {"degree": 1}),
    "trigonometric-3": ("trigonometric", ["revolute"] * 3, True, False, {"degree": [2, 0, 2]}),
    "black-box-delan-3": ("black-box-delan", ARM, True, False, {**CONVEX, "rate_scale": [1.0, 0.5, 2.0]}),
    "black-box-hnn-2": ("black-box-hnn", MIXED, True, True, {**CONVEX, "momentum_scale": [1.0, 2.0], "iterations": 12}),
    "feed-forward-2": ("feed-forward", MIXED, True, False, {**NETWORK, "tau_scale": [2.0, 3.0]}),
}


def random_model(case):
    """Description and parameters that no initialisation would give: biases are not zero."""
    kind, joints, gravity, friction, keywords = CASES[case]
    needs = {"joints": joints, "gravity": gravity, "friction": friction, "actuation": None}
    description = describe(kind, needs=needs, precision="f64", **keywords)
    random, init = np.random.default_rng(len(case)), build(description).init
    if kind == "trigonometric":  # starts from M = 1, which small changes leave definite
        return description, jax.tree.map(lambda leaf: leaf + 0.02 * random.normal(size=leaf.shape), init(KEY))

    def drawn(path, leaf):
        # Convex in its inputs, so that mass matrices are definite and each velocity has a momentum.
        convex = kind in ("black-box-delan", "black-box-hnn") and "linear_0" not in str(path) and len(leaf.shape) == 2
        values = 0.5 * random.normal(size=leaf.shape)
        return jnp.asarray(np.abs(values) + 0.1 if convex else values)

    # Drawn here and not by `init`, which is slow to compile.
    return description, jax.tree_util.tree_map_with_path(drawn, jax.eval_shape(init, KEY))


def relative_error(got, expected):
    """Largest difference over the largest number."""
    return np.abs(np.asarray(got) - expected).max() / np.abs(expected).max()


def random_states(energies, case, d):
    """q, qd and a third vector; velocities of a general Hamiltonian are those of random momenta."""
    states = np.random.default_rng(1).uniform(-1, 1, (STATES, 3, d)) * np.array([3.0, 1.0, 2.0])[:, None]
    if not case.startswith("black-box-hnn"):
        return states
    velocity = jax.jit(jax.vmap(jax.grad(hamiltonian_of(energies), argnums=1)))
    states[:, 1] = velocity(states[:, 0], 0.5 * states[:, 1])
    return states


@needs_compiler
@pytest.mark.parametrize("case", CASES)
def test_c_equals_jax_on_random_states(case, tmp_path):
    description, parameters = random_model(case)
    energies = build(description).energies(parameters)
    model = dynamics(energies)
    states = random_states(energies, case, len(CASES[case][1]))

    @jax.jit
    @jax.vmap
    def everything(state):
        q, qd, x = state
        motion = model.inverse_dynamics(q, qd, x), model.forward_dynamics(q, qd, x)
        return (*motion, model.energy(q, qd), model.mass_matrix(q, qd)) if isinstance(model, Dynamics) else motion

    expected = [np.asarray(array) for array in everything(states)]
    assert all(np.isfinite(array).all() and array.std() > 0 for array in expected[:2])
    for precision, bound in BOUND.items():
        export_c(description, parameters, tmp_path / precision, precision=precision)
        # Compiled quickly, but for one case, which is compiled as users do.
        flags = FLAGS if case == "delan-2-shared" else ("-O0",)
        system = load_c(tmp_path / precision, flags=(*flags, *STRICT))
        calls = [system.inverse_dynamics, system.forward_dynamics]
        assert isinstance(system, CDynamics if isinstance(model, Dynamics) else CPlainDynamics)
        if isinstance(system, CDynamics):
            calls += [lambda q, qd, _, f=f: f(q, qd) for f in (system.energy, system.mass_matrix)]
        for function, wanted in zip(calls, expected, strict=True):
            got = [function(*state) for state in states]
            assert np.asarray(got[0]).dtype == (np.float64 if np.ndim(got[0]) == 0 else f"float{precision[1:]}")
            assert relative_error(got, wanted) < bound


FUNCTIONS = {
    "1-1": ([1, 6, 1], 1, "cos"),
    "2-1-ensemble": ([2, 4, 4, 1], 3, "gelu"),
    "2-5-forward": ([2, 8, 5], 1, "tanh"),
    "3-2-linear": ([3, 2], 2, "tanh"),
}


def random_function(case):
    sizes, members, activation = FUNCTIONS[case]
    random = np.random.default_rng(3)
    layers = tuple(
        tuple(jnp.asarray(0.7 * random.normal(size=(members, *shape))) for shape in ((n, m), (m,)))
        for n, m in differential_mlp.layer_shapes(sizes)
    )
    stated = {"sizes": sizes, "members": members, "activation": activation}
    return describe("differential-network", precision="f64", **stated), layers


@needs_compiler
@pytest.mark.parametrize("case", FUNCTIONS)
def test_a_differential_network_equals_its_c(case, tmp_path):
    sizes, _, activation = FUNCTIONS[case]
    description, layers = random_function(case)
    points = np.random.default_rng(2).normal(size=(STATES, sizes[0])) * 2

    @jax.jit
    @jax.vmap
    def expected(x):
        each = jax.vmap(
            lambda ours: differential_mlp.value_and_jacobian(ours, x, activation=activations.activation(activation))
        )(layers)
        return jax.tree.map(lambda array: array.mean(axis=0), each)

    value, jacobian = map(np.asarray, expected(points))
    for precision in BOUND:
        export_c(description, layers, tmp_path / precision, precision=precision)
        function = load_c(tmp_path / precision, flags=("-O0", *STRICT))
        assert isinstance(function, CFunction)
        assert relative_error([function.value(x) for x in points], value) < BOUND[precision]
        both = [function.value_and_jacobian(x) for x in points]
        assert relative_error([y for y, _ in both], value) < BOUND[precision]
        assert relative_error([slope for _, slope in both], jacobian) < BOUND[precision]


@needs_compiler
@pytest.mark.parametrize("name", activations.ALL)
def test_each_activation_has_its_first_two_derivatives(name, tmp_path):
    """L = w·g(W [cos q, sin q, qd] + b), whose M and energy take g, g' and g''; closed forms, from -30 to 30."""
    needs = {"joints": SWING, "gravity": True, "friction": False, "actuation": None}
    description = describe("black-box-delan", needs=needs, precision="f64", width=6, depth=1, activation=name)
    random = np.random.default_rng(4)
    weight, bias, output = random.normal(size=(3, 6)), random.normal(size=6), random.normal(size=(6, 1))
    layers = [{"w": weight, "b": bias}, {"w": output, "b": np.zeros(1)}]
    parameters = {f"lagrangian/~/linear_{index}": layer for index, layer in enumerate(layers)}
    export_c(description, parameters, tmp_path)
    system = load_c(tmp_path, flags=("-O0", *STRICT))
    q, qd = random.uniform(-3, 3, 200), random.uniform(-10, 10, 200)
    a = jnp.asarray(np.stack([np.cos(q), np.sin(q), qd], axis=1) @ weight + bias)
    g = activations.activation(name)
    mass = g.second(a) @ (output[:, 0] * weight[2] ** 2)
    energy = qd * np.asarray(g.first(a) @ (output[:, 0] * weight[2])) - np.asarray(g.value(a) @ output[:, 0])
    got = [(system.mass_matrix([q], [qd])[0, 0], system.energy([q], [qd])) for q, qd in zip(q, qd, strict=True)]
    np.testing.assert_allclose([each for each, _ in got], mass, rtol=0, atol=1e-13 * max(1, np.abs(mass).max()))
    np.testing.assert_allclose([each for _, each in got], energy, rtol=0, atol=1e-13 * np.abs(energy).max())


@needs_compiler
@pytest.mark.parametrize("case", ["delan-2-shared", "hnn-2", "trigonometric-2", "black-box-hnn-2", "2-1-ensemble"])
def test_the_demo_is_clean_under_the_sanitizers(case, tmp_path):
    make = random_function if case in FUNCTIONS else random_model
    description, parameters = make(case)
    precision = "f32" if case == "hnn-2" else "f64"
    export_c(description, parameters, tmp_path, name="arm", precision=precision)
    program = tmp_path / "arm_demo"
    sanitizers = "-fsanitize=address,undefined"
    sources = [str(tmp_path / "arm.c"), str(tmp_path / "arm_demo.c")]
    compile_c([*STRICT, "-g", "-O1", sanitizers, "-fno-sanitize-recover=all", *sources, "-lm", "-o", str(program)])
    result = subprocess.run([program, "200"], capture_output=True, text=True)
    assert result.returncode == 0 and not result.stderr, result.stderr
    lines = dict(line.split(": ", 1) for line in result.stdout.splitlines())
    if case in FUNCTIONS:
        assert re.match(r"\d+ calls/s", lines["arm_value"])
        return
    assert re.match(r"\d+ calls/s", lines["arm_inverse_dynamics"])
    if case != "black-box-hnn-2":  # whose states need not have a momentum
        numbers = {key: np.array(lines[key].split(), float) for key in ("qdd", "qdd from tau")}
        np.testing.assert_allclose(numbers["qdd from tau"], numbers["qdd"], rtol=1e-4 if precision == "f32" else 1e-8)


@needs_compiler
def test_a_state_that_is_not_finite_gives_results_that_are_not(tmp_path):
    description, parameters = random_model("delan-1")
    export_c(description, parameters, tmp_path)
    system = load_c(tmp_path)
    assert np.isnan(system.inverse_dynamics([np.nan], [1.0], [1.0])).all()
    assert np.isnan(system.inverse_dynamics([0.0], [np.inf], [1.0])).all()
    description, layers = random_function("2-5-forward")
    export_c(description, layers, tmp_path / "network")
    network = load_c(tmp_path / "network")
    assert np.isnan(network.value([np.nan, 0.0])).all()
    # Saturation: the network is constant, and its Jacobian zero.
    value, jacobian = network.value_and_jacobian([1e6, 1e6])
    np.testing.assert_array_equal(value, network.value([2e6, 2e6]))
    assert np.abs(jacobian).max() < 1e-14


@needs_compiler
@pytest.mark.skipif(not shutil.which("cmake"), reason="there is no cmake on the PATH")
def test_cmake_builds_library_and_demo(tmp_path):
    export_c(*random_model("trigonometric-1"), tmp_path, name="swing")
    # One folder per model: a second one would need a CMake file of its own.
    with pytest.raises(InputError, match=r"holds CMakeLists\.txt already"):
        export_c(*random_model("trigonometric-1"), tmp_path, name="other")
    for arguments in (["-S", ".", "-B", "build"], ["--build", "build"]):
        subprocess.run(["cmake", *arguments], cwd=tmp_path, check=True, capture_output=True)
    assert "mass matrix" in subprocess.run([tmp_path / "build" / "swing_demo"], capture_output=True, text=True).stdout


def test_files_are_the_same_each_time_and_say_what_they_are():
    model = random_model("delan-2-shared")
    once, again = (source_files(*model, name="arm", precision="f32") for _ in range(2))
    assert once == again
    header, source = once["arm.h"].decode(), once["arm.c"].decode()
    for words in ("from a structured-delan", "C format 2", "prismatic (m), revolute (rad)", "N m", "without friction"):
        assert words in header
    assert "void arm_inverse_dynamics(const float q[2], const float qd[2], const float qdd[2], float tau[2]);" in header
    assert re.findall(r"#include (\S+)", source) == ["<math.h>", '"arm.h"']
    assert not re.search(r"\b(malloc|static (?!const|void|real)|double)\b", source)
    assert json.loads(once["arm.json"])["functions"].keys() >= {"inverse_dynamics", "mass_matrix"}


@pytest.fixture
def folder(tmp_path):
    """The run folder of a model of dynamics."""
    (tmp_path / "run").mkdir()
    save(tmp_path / "run", *random_model("delan-1"))
    return tmp_path / "run"


def command(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["export_c", *map(str, arguments)])
    run(script.main, script.Arguments, prog="command")


def refused(monkeypatch, capsys, *arguments):
    with pytest.raises(SystemExit) as exit_:
        command(monkeypatch, *arguments)
    line = capsys.readouterr().err
    assert exit_.value.code == 2 and line.startswith("error: ") and line.count("\n") == 1
    return line


@needs_compiler
def test_the_command_exports_runs_of_both_sorts(folder, monkeypatch, capsys):
    out = folder.parent / "c"
    command(monkeypatch, "--run", folder, "--out", out, "--name", "swing", "--precision", "f32")
    assert {path.name for path in out.iterdir()} == {
        *("swing.h", "swing.c", "swing_demo.c", "swing.json", "CMakeLists.txt")
    }
    assert "swing.h, swing.c" in capsys.readouterr().out
    before = (out / "swing.c").read_bytes()
    (out / "swing.c").write_text("mine")
    line = refused(monkeypatch, capsys, "--run", folder, "--out", out, "--name", "swing")
    assert "swing.c" in line and "already" in line and (out / "swing.c").read_text() == "mine"
    command(monkeypatch, "--run", folder, "--out", out, "--name", "swing", "--precision", "f32", "--overwrite")
    assert (out / "swing.c").read_bytes() == before

    (folder.parent / "function").mkdir()
    save(folder.parent / "function", *random_function("2-1-ensemble"))
    command(monkeypatch, "--run", folder.parent / "function", "--out", folder.parent / "f")
    assert load_c(folder.parent / "f").value([0.1, 0.2]).shape == (1,)


def test_mistakes_are_one_line_and_leave_nothing_behind(folder, monkeypatch, capsys):
    out = folder.parent / "refused"
    there = ("--run", folder, "--out", out)
    assert "no such file" in refused(monkeypatch, capsys, "--run", folder / "void", "--out", out)
    for name in ("2x;y", "double", "", "Main", "ä", "x" * 41):
        assert "expected a C name" in refused(monkeypatch, capsys, *there, f"--name={name}")
    manifest = json.loads((folder / "model.json").read_text())
    (folder.parent / "other").mkdir()
    polynomial = describe("polynomial-hamiltonian", needs=Needs(joints=("revolute",)), precision="f64")
    save(folder.parent / "other", polynomial, build(polynomial).init(KEY))
    assert "a polynomial-hamiltonian has no C export; exportable are structured-delan" in refused(
        monkeypatch, capsys, "--run", folder.parent / "other", "--out", out
    )
    bent = describe(
        "structured-hnn", needs=Needs(joints=("revolute",), friction=True), precision="f64", friction_width=2
    )
    with pytest.raises(InputError, match="a friction that depends on q has no C export"):
        export_c(bent, {}, out)
    (folder / "model.json").write_text(json.dumps({**manifest, "model": None}))
    assert "describes no model" in refused(monkeypatch, capsys, *there)
    assert not out.exists()


def test_what_cannot_be_exported_is_refused(tmp_path):
    description, parameters = random_model("delan-1")
    large = jax.tree.map(lambda leaf: leaf * 1e300, parameters)
    with pytest.raises(InputError, match="f32 cannot hold"):
        export_c(description, large, tmp_path, precision="f32")
    with pytest.raises(InputError, match="precision is 'f16'"):
        export_c(description, parameters, tmp_path, precision="f16")
    with pytest.raises(InputError, match="activation is 'sigmoid'"):
        export_c({**description, "activation": "sigmoid"}, parameters, tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot write there"):
        export_c(description, parameters, tmp_path / "file" / "below")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_the_loader_says_what_is_missing(tmp_path, monkeypatch):
    with pytest.raises(InputError, match="no such file"):
        load_c(tmp_path)
    export_c(*random_model("delan-1"), tmp_path)
    with pytest.raises(InputError, match=r"no C compiler \(nonesuch\)"):
        load_c(tmp_path, compiler="nonesuch")
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    with pytest.raises(InputError, match=r"no C compiler .*install gcc or clang"):
        load_c(tmp_path)
    monkeypatch.undo()
    if shutil.which("cc"):
        with pytest.raises(InputError, match=r"could not compile the model: .*error"):
            load_c(tmp_path, flags=("--no-such-flag",))
    monkeypatch.setattr(c_interface, "FORMAT", 3)
    with pytest.raises(InputError, match="C format 2; this release reads format 3"):
        load_c(tmp_path)


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("name", ["model", "checkpoint", "config", "metrics", "arm"])
def test_a_run_is_never_written_over(folder, monkeypatch, capsys, name):
    (folder / "config.json").write_text("{}")
    before = contents(folder)
    line = refused(monkeypatch, capsys, "--run", folder, "--out", folder, "--name", name, "--overwrite")
    assert "the folder of a run" in line and contents(folder) == before
    # Where no manifest says so, what describes no export stays as it is.
    (folder.parent / "other").mkdir()
    (folder.parent / "other" / f"{name}.json").write_text('{"torque_mse": 1.0}')
    there = ("--run", folder, "--out", folder.parent / "other", "--name", name, "--overwrite")
    assert "describes no export of this name" in refused(monkeypatch, capsys, *there)
    assert contents(folder.parent / "other") == {f"{name}.json": b'{"torque_mse": 1.0}'}


def test_what_is_no_file_is_not_replaced(tmp_path):
    (tmp_path / "model.c").mkdir()
    with pytest.raises(InputError, match=r"model\.c is no file"):
        export_c(*random_model("delan-1"), tmp_path, overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["model.c"]


class Killed(BaseException):
    """Ends a process as a signal would."""


@pytest.mark.parametrize("renamed", range(7))
def test_a_kill_leaves_an_old_export_or_a_new_one_or_a_refusal(tmp_path, monkeypatch, renamed):
    """Two exports of two files, in place of older ones, killed before any of the six renames."""
    old, new = ({f"{name}.{end}": age + end.encode() for name in "ab" for end in "hc"} for age in (b"old ", b"new "))

    def written(files):
        ours = {name: {key: data for key, data in files.items() if key.startswith(name)} for name in "ab"}
        return {**files, **{f"{name}.json": described({"age": 1}, each) for name, each in ours.items()}}

    write_exports(tmp_path, written(old), overwrite=False)
    replace, count = Path.replace, iter(range(7))

    def killed_before(self, target):
        if next(count) == renamed:
            raise Killed
        return replace(self, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", killed_before)
        patch.setattr(Path, "unlink", lambda self, **_: None)
        if renamed == 6:
            write_exports(tmp_path, written(new), overwrite=True)
        else:
            with pytest.raises(Killed):
                write_exports(tmp_path, written(new), overwrite=True)
    read = {}
    for name in "ab":
        try:
            read |= read_export(tmp_path / f"{name}.json", (f"{name}.h", f"{name}.c"))[1]
        except InputError as error:
            assert "truncated or altered" in str(error)
    # Never old beside new among what is accepted.
    assert read.items() <= old.items() or read.items() <= new.items()
    assert renamed not in (0, 6) or read == (new if renamed else old)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Files of an exported model with d = 1, by name."""
    folder = tmp_path_factory.mktemp("exported")
    export_c(*random_model("delan-1"), folder)
    return contents(folder)


ALTERED = {
    "source": ({"model.c": b"int x;"}, r"model\.c: truncated or altered"),
    "header": ({"model.h": b""}, r"model\.h: truncated or altered"),
    "no source": ({"model.c": None}, r"model\.c: cannot be read"),
    "no description": ({"model.json": None}, "no such file"),
    "truncated": ({"model.json": b'{"format": 2,'}, "not readable as JSON"),
    "no object": ({"model.json": b"[]"}, "holds a list"),
    "older": ({"model.json": b'{"format": 1, "precision": "f64", "d": 1}'}, "of an older release"),
    "files": ({"model.json": b'{"sha256": "0", "files": "model.c"}'}, "describes no export"),
}


@pytest.mark.parametrize("case", ALTERED)
def test_files_that_are_not_as_written_are_refused(case, exported, tmp_path):
    changes, message = ALTERED[case]
    for name, data in {**exported, **changes}.items():
        if data is not None:
            (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match=message) as error:
        load_c(tmp_path)
    assert "\n" not in str(error.value)


STATED = {
    "precision": ("f32", "functions is"),
    "kind": ("black-box-delan", "functions is"),
    "d": (2, "functions is"),
    "name": ("arm", "name is 'arm', expected 'model'"),
    "version": (1, "version is 1"),
    "functions": ({}, "functions is {}"),
    "n": (3, "n is 3, expected None"),
    "format": (7, "C format 7"),
}
OUT_OF_RANGE = [
    *(("d", value) for value in (0, -1, True, 1.0, "1", None, [1], 10**9)),
    *(("precision", value) for value in ("f16", None, {})),
    *(("kind", value) for value in ("pairwise", None, [])),
]


def test_no_field_of_a_description_is_believed(exported, tmp_path):
    stated = json.loads(exported["model.json"])
    facts = {key: value for key, value in stated.items() if key not in ("files", "sha256")}
    files = {name: exported[name] for name in stated["files"]}
    for name, data in exported.items():
        (tmp_path / name).write_bytes(data)
    cases = [(key, *case) for key, case in STATED.items()]
    cases += [(key, value, rf"{key} is .*; expected") for key, value in OUT_OF_RANGE]
    for key, value, message in cases:
        (tmp_path / "model.json").write_text(json.dumps({**stated, key: value}))
        with pytest.raises(InputError, match="truncated or altered"):
            load_c(tmp_path)
        # The same with digests that fit.
        (tmp_path / "model.json").write_bytes(described({**facts, key: value}, files))
        with pytest.raises(InputError, match=message):
            load_c(tmp_path)
    with pytest.raises(InputError, match="expected a C name"):
        load_c(tmp_path, name="../model")


WRONG = {
    "one number": 0.1,
    "of one": [0.1],
    "of four": np.zeros(4),
    "a batch": np.zeros((5, 2)),
    "a batch of one": np.zeros((1, 2)),
    "columns": np.zeros((2, 1)),
    "words": ["a", "b"],
    "ragged": [1, [2]],
    "nothing": None,
}


@needs_compiler
def test_arguments_of_another_shape_are_refused_by_name(tmp_path):
    for case in ("hnn-2", "black-box-delan-3", "delan-1"):
        export_c(*random_model(case), tmp_path / case, precision="f64")
    export_c(*random_function("2-5-forward"), tmp_path / "function")
    system = load_c(tmp_path / "hnn-2", flags=("-O0",))
    calls = {
        "qdd": lambda x: system.inverse_dynamics(np.zeros(2), np.zeros(2), x),
        "tau": lambda x: system.forward_dynamics(np.zeros(2), np.zeros(2), x),
        "q": lambda x: system.inverse_dynamics(x, [0.0, 0.0], np.zeros(2)),
        "qd": lambda x: system.energy(np.zeros(2), x),
        "q ": system.mass_matrix,
        "qd ": lambda x: system.mass_matrix(np.zeros(2), x),
        "x": load_c(tmp_path / "function", flags=("-O0",)).value_and_jacobian,
    }
    for name, call in calls.items():
        for sort, wrong in WRONG.items():
            if name == "qd " and sort == "nothing":
                continue  # which it may be
            with pytest.raises(InputError, match=rf"^{name.strip()} (has|makes) .*expected.*\(2,\)"):
                call(wrong)
        call(np.ones(2, np.float32)), call([1, 2])
    of_state = load_c(tmp_path / "black-box-delan-3", flags=("-O0",)).mass_matrix
    with pytest.raises(InputError, match="qd has shape"):
        of_state(np.zeros(3), np.zeros(2))
    # Leading axes of one are no batch to NumPy's assignment.
    with pytest.raises(InputError, match="q has shape"):
        load_c(tmp_path / "delan-1", flags=("-O0",)).inverse_dynamics(np.zeros((1, 1)), np.zeros(1), np.zeros(1))
