"""The files of an export: what they state, how they build, what the loader believes of them, and what they need."""

import contextlib
import json
import platform
import re
import shutil
import subprocess
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from comparison import STRICT, files_of
from compilers import needs_compiler
from jax import lax
from sanitized import SANITIZERS

from dln_jax.export.c import interface
from dln_jax.export.c.load import STANDARD, compile_c, load_c
from dln_jax.export.c.source import export_c
from dln_jax.types import InputError
from dln_jax.zoo.parameter_files import save_tree

needs_x86 = pytest.mark.skipif(
    not shutil.which("gcc") or platform.machine() != "x86_64", reason="-mfpmath is an option of gcc on x86"
)
W = np.random.default_rng(0).normal(size=(33, 20))


def step(x, u):
    return {"x_next": x[::-1] + u[0] * jnp.sin(x)}


def solved(q, i):
    m = jnp.outer(q, q) + 3 * jnp.eye(3, dtype=q.dtype)
    turned = lax.scan(lambda c, y: (jnp.cos(c) + y, c), q, jnp.stack([q, q]))[1]
    solution = lax.while_loop(lambda s: s[1] < 4, lambda s: (jnp.linalg.solve(m, s[0]), s[1] + 1), (q, 0))[0]
    return solution, turned.at[i].add(2.0), lax.cond(q[0] > 0, jnp.tanh, jnp.exp, jnp.linalg.cholesky(m))


FUNCTIONS = {
    "step": (step, (np.zeros(4), np.zeros(1))),
    "network": (lambda x: jnp.tanh(x @ W.astype(x.dtype)), (np.zeros(33),)),
    "logs": (lambda x: (jnp.expm1(x), jnp.log(x), jnp.log1p(x)), (np.zeros(9),)),
    "solved": (solved, (np.zeros(3), np.array([1, 0]))),
    "energy": (lambda x, k: x @ x + k, (np.zeros(3), np.zeros(()))),
}


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Returns the folder of an export."""
    folder = tmp_path_factory.mktemp("exported")
    export_c(FUNCTIONS, folder)
    return folder


@pytest.fixture
def exported(folder):
    """Files of the export, by name."""
    return contents(folder)


def test_files_are_the_same_each_time_and_say_what_they_are():
    once, again = (files_of(FUNCTIONS, name="arm", precision="f32") for _ in range(2))
    assert once == again
    assert {*once} == {"arm.h", "arm.c", "arm_demo.c", "arm.json", "CMakeLists.txt"}
    header, source = once["arm.h"].decode(), once["arm.c"].decode()
    assert f"C format {interface.FORMAT}" in header
    assert "void arm_step(const float x[4], const float u[1], float x_next[4]);" in header
    assert "float arm_energy(const float x[3], float k);" in header
    assert "const int64_t i[2]" in files_of(FUNCTIONS, name="arm")["arm.h"].decode()
    assert re.findall(r"#include (\S+)", source) == ["<float.h>", "<math.h>", "<stdint.h>", '"arm.h"']
    assert not re.search(r"\b(malloc|static (?!const|inline|void)|double)\b", source)
    stated = json.loads(once["arm.json"])["functions"]
    for facts in stated.values():
        assert f"{facts['operations']} floating-point operations, {facts['stack_bytes']} bytes of stack" in header


@needs_compiler
def test_the_demo_is_clean_under_the_sanitizers(tmp_path):
    export_c(FUNCTIONS, tmp_path, name="arm", precision="f32")
    sources, program = [str(tmp_path / "arm.c"), str(tmp_path / "arm_demo.c")], tmp_path / "arm_demo"
    compile_c([*STANDARD, *STRICT[:-1], "-g", "-O0", *SANITIZERS, *sources, "-lm", "-o", str(program)])
    for calls in ("200", "1"):  # one call takes less than a step of the clock
        result = subprocess.run([program, calls], capture_output=True, text=True)
        assert result.returncode == 0 and not result.stderr, result.stderr
        for name in FUNCTIONS:
            assert re.search(rf"^arm_{name}: \d+ calls/s", result.stdout, re.MULTILINE)


@needs_compiler
def test_an_object_has_no_state_and_needs_libm_only(folder, tmp_path):
    compile_c(["-O1", "-DDLN_OWN_ELEMENTARY", "-c", str(folder / "model.c"), "-o", str(tmp_path / "model.o")])
    nm = subprocess.run(["nm", tmp_path / "model.o"], capture_output=True, text=True, check=True).stdout
    sorts = {line.split()[-1]: line.split()[-2] for line in nm.splitlines()}
    # Text, and constants: no data that can change.
    assert {*sorts.values()} <= {"T", "t", "r", "U"}
    needed = {name for name, sort in sorts.items() if sort == "U"}
    assert needed <= {"sin", "cos", "sqrt", "exp", "tanh", "fabs", "memcpy", "memset", "__stack_chk_fail"}, needed
    assert {name for name, sort in sorts.items() if sort == "T"} == {f"model_{name}" for name in FUNCTIONS}


@needs_compiler
@pytest.mark.skipif(not shutil.which("g++"), reason="there is no C++ compiler on the PATH")
def test_the_source_is_cpp_too(folder):
    compile_c(
        ["-pedantic", *STRICT, "-DDLN_OWN_ELEMENTARY", "-fsyntax-only", "-x", "c++", str(folder / "model.c")], "g++"
    )


@needs_x86
def test_functions_of_the_c_library_bear_extended_precision(tmp_path):
    export_c({"network": FUNCTIONS["network"]}, tmp_path)
    x = np.linspace(-1, 1, 33)
    loaded = load_c(tmp_path, compiler="gcc", flags=("-O0", *STRICT, "-mfpmath=387"))
    np.testing.assert_allclose(loaded.network(x), np.tanh(x @ W), rtol=1e-12)


@needs_compiler
@pytest.mark.skipif(not shutil.which("cmake"), reason="there is no cmake on the PATH")
def test_cmake_builds_library_and_demo(tmp_path):
    export_c(FUNCTIONS, tmp_path, name="swing")
    # One folder per export: a second one would need a CMake file of its own.
    with pytest.raises(InputError, match=r"already contains CMakeLists\.txt"):
        export_c(FUNCTIONS, tmp_path, name="other")
    for arguments in (["-S", ".", "-B", "build", "-DDLN_OWN_ELEMENTARY=ON"], ["--build", "build"]):
        subprocess.run(["cmake", *arguments], cwd=tmp_path, check=True, capture_output=True)
    assert "x_next" in subprocess.run([tmp_path / "build" / "swing_demo"], capture_output=True, text=True).stdout


def test_the_loader_says_what_is_missing(folder, tmp_path, monkeypatch):
    with pytest.raises(InputError, match="no such file"):
        load_c(tmp_path)
    with pytest.raises(InputError, match=r"no C compiler \(nonesuch\)"):
        load_c(folder, compiler="nonesuch")
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    with pytest.raises(InputError, match=r"no C compiler .*install gcc or clang"):
        load_c(folder)
    monkeypatch.undo()
    if shutil.which("cc"):
        with pytest.raises(InputError, match=r"could not compile the model: .*error"):
            load_c(folder, flags=("--no-such-flag",))
    monkeypatch.setattr(interface, "FORMAT", 99)
    with pytest.raises(InputError, match="C format 6; this release reads format 99"):
        load_c(folder)


def test_what_is_no_file_is_not_replaced(tmp_path):
    (tmp_path / "model.c").mkdir()
    with pytest.raises(InputError, match=r"model\.c is not a file"):
        export_c(FUNCTIONS, tmp_path, overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["model.c"]


class Killed(BaseException):
    """Ends a process as a signal would."""


def test_a_kill_leaves_an_old_export_or_a_new_one_or_a_refusal(tmp_path, monkeypatch):
    """An export in place of an older one, killed before any of its renames."""
    old, new = ({"f": (lambda x, k=k: k * x, (np.ones(2),))} for k in (2.0, 3.0))
    before, after = files_of(old), files_of(new)
    replace = Path.replace
    monkeypatch.setattr(Path, "unlink", lambda self, **_: None)
    total = len(after)
    for renamed in range(total + 1):
        folder, count = tmp_path / str(renamed), iter(range(total + 1))
        export_c(old, folder)

        def killed_before(self, target, count=count, renamed=renamed):
            if next(count) == renamed:
                raise Killed
            return replace(self, target)

        with monkeypatch.context() as patch, contextlib.suppress(Killed):
            patch.setattr(Path, "replace", killed_before)
            export_c(new, folder, overwrite=True)
        assert next(count) == min(renamed + 1, total)
        try:
            source = interface.read_interface(folder, "model")[2]["model.c"]
        except InputError as error:
            assert 0 < renamed < total and "is altered, renamed or from another export" in str(error)
        else:
            assert source == (after if renamed == total else before)["model.c"]


ALTERED = {
    "source": ({"model.c": b"int x;"}, r"model\.c is altered"),
    "header": ({"model.h": b""}, r"model\.c is altered"),
    "no source": ({"model.c": None}, r"model\.c: cannot be read"),
    "no description": ({"model.json": None}, "no such file"),
    "truncated": ({"model.json": b'{"format": 2,'}, "not readable as JSON"),
    "older": ({"model.json": b'{"format": 1, "precision": "f64", "d": 1}'}, "C format 1; this release reads format 6"),
    "format alone": ({"model.json": b'{"format": 6}'}, r"model\.c is altered"),
}


def test_files_that_are_not_as_written_are_refused(exported, tmp_path):
    for case, (changes, message) in ALTERED.items():
        (tmp_path / case).mkdir()
        for name, data in {**exported, **changes}.items():
            if data is not None:
                (tmp_path / case / name).write_bytes(data)
        with one_line(message):
            load_c(tmp_path / case)


CHANGES = (
    (b'"f64"', b'"f32"'),
    (b'"name": "model"', b'"name": "arm"'),
    (b'"operations": ', b'"operations": 1'),
    (b'"energy"', b'"energy_2"'),
)


def test_a_changed_description_is_refused(exported, tmp_path):
    for name, data in exported.items():
        (tmp_path / name).write_bytes(data)
    for there, changed in CHANGES:
        assert there in exported["model.json"]
        (tmp_path / "model.json").write_bytes(exported["model.json"].replace(there, changed, 1))
        with one_line(r"model\.c is altered, renamed or from another export"):
            load_c(tmp_path)
    for name, data in exported.items():
        (tmp_path / name.replace("model", "arm")).write_bytes(data)
    with one_line("is altered, renamed"):
        load_c(tmp_path, name="arm")
    with pytest.raises(InputError, match="expected a C name"):
        load_c(tmp_path, name="../model")


@needs_x86
def test_flags_that_give_wrong_numbers_do_not_compile(folder):
    for flag in ("-ffast-math", "-ffinite-math-only", "-mfpmath=387 -DDLN_OWN_ELEMENTARY"):
        with pytest.raises(InputError, match=r"#error .*(-ffast-math|-mfpmath=sse)"):
            load_c(folder, compiler="gcc", flags=flag.split())


def test_an_export_never_takes_the_place_of_a_runs_file(tmp_path):
    save_tree(tmp_path, "model", {"w": np.ones(2)}, {})
    before = contents(tmp_path)
    for name in ("model", "config"):
        with pytest.raises(InputError, match="is the folder of a run"):
            export_c(FUNCTIONS, tmp_path, name=name, overwrite=True)
    assert contents(tmp_path) == before


def test_results_keep_the_order_in_which_they_were_written_and_a_shape_is_an_example():
    files = files_of({"f": (lambda x: {"z": x[0], "a": x}, (jax.ShapeDtypeStruct((3,), float),))}, name="m")
    assert "void m_f(const double x[3], double z[1], double a[3]);" in files["m.h"].decode()
