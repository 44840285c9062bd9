"""Elementary functions of exported C against mpmath, and what a compiler makes of them."""

import ctypes
import functools
import platform
import re
import shutil
import subprocess
from pathlib import Path

import mpmath
import numpy as np
import pytest

from dln_jax.export.c.elementary import BOUNDS, OPERATIONS, VECTORISED, definitions
from dln_jax.export.c.load import FLAGS, compile_c

STRICT = (
    *("-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-Wshadow", "-Werror"),
    *("-fPIC", "-shared"),
)
TYPES = {"f64": (np.float64, "double", ""), "f32": (np.float32, "float", "f")}
needs_compiler = pytest.mark.skipif(
    not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="there is no C compiler on the PATH"
)
needs_gcc = pytest.mark.skipif(
    not shutil.which("gcc") or "Free Software" not in subprocess.getoutput("gcc --version"), reason="there is no gcc"
)
by_precision = pytest.mark.parametrize("precision", TYPES)


def source(precision: str) -> str:
    """`evaluate_NAME(n, x, y)` for each function, and for sines [n] and cosines [n] of the same numbers."""
    _, real, suffix = TYPES[precision]
    loops = "".join(
        f"void evaluate_{name}(int n, const real *x, real *y);\n"
        f"void evaluate_{name}(int n, const real *x, real *y)\n"
        f"{{\n    elementary_{name}_each(n, x, y);\n}}\n"
        for name in VECTORISED
    )
    loops += (
        "void evaluate_sin_cos(int n, const real *x, real *y);\n"
        "void evaluate_sin_cos(int n, const real *x, real *y)\n"
        "{\n    for (int i = 0; i < n; ++i) elementary_sin_cos(x[i], &y[i], &y[n + i]);\n}\n"
    )
    return (
        f"#include <float.h>\n#include <math.h>\n#include <stdint.h>\ntypedef {real} real;\n"
        f"#if defined FP_FAST_FMA{suffix.upper()} && !defined UNFUSED\n"
        f"#define MULTIPLY_ADD(a, b, c) fma{suffix}(a, b, c)\n#else\n"
        "#define MULTIPLY_ADD(a, b, c) ((a) * (b) + (c))\n#endif\n"
        "#ifdef __cplusplus\n#define RESTRICT\n#else\n#define RESTRICT restrict\n#endif\n"
        f"{definitions(['sin_cos'], precision, arrays=VECTORISED)}"
        f'#ifdef __cplusplus\nextern "C" {{\n#endif\n{loops}#ifdef __cplusplus\n}}\n#endif\n'
    )


@pytest.fixture(scope="module")
def evaluate(tmp_path_factory):
    """(name, x, fused) -> y of the compiled function, at the precision of x."""
    folder: Path = tmp_path_factory.mktemp("elementary")

    @functools.cache
    def library(precision, fused):
        text, built = folder / f"{precision}.c", folder / f"{precision}_{fused}.so"
        text.write_text(source(precision))
        compile_c(["-std=c99", *STRICT, *FLAGS, *["-DUNFUSED"] * (not fused), str(text), "-lm", "-o", str(built)])
        return ctypes.CDLL(str(built))

    def call(name, x, fused=True):
        y = np.empty_like(x, shape=(2, x.size) if name == "sin_cos" else None)
        function = getattr(library("f64" if x.dtype == np.float64 else "f32", fused), f"evaluate_{name}")
        function(ctypes.c_int(x.size), ctypes.c_void_p(x.ctypes.data), ctypes.c_void_p(y.ctypes.data))
        return y

    return call


def points(name: str, precision: str) -> np.ndarray:
    """Random numbers of every binade where the function is defined and not constant, and the hard ones."""
    numpy_type, random = TYPES[precision][0], np.random.default_rng(VECTORISED.index(name))
    limits, half_pi = np.finfo(numpy_type), np.pi / 2
    exponents = np.concatenate([np.arange(limits.minexp - limits.nmant, limits.maxexp), np.arange(-6, 18).repeat(30)])
    x = np.ldexp(random.uniform(1, 2, exponents.size), exponents)
    # Thresholds: of the overflow of exp and the smallest normal number, and where tanh and expm1 become constant.
    x = np.concatenate([x, np.log([limits.max, 1 / limits.tiny]), [0.55, 20.0, 40.0, 0.5, 1.0, 2.0, np.sqrt(0.5)]])
    if name in BOUNDS:
        bound = BOUNDS[name][precision]
        # 161 pi/2 and 29 pi/2 are the multiples nearest to a float and a double within the bounds.
        hardest = np.outer([29, 161], 2 ** np.arange(12)).ravel()
        multiples = np.concatenate([np.arange(1, 30), hardest, random.integers(1, int(bound / half_pi), 200)])
        x = np.concatenate([x, half_pi * multiples])
        x = np.append(x[x < bound], bound)
    near = x.astype(numpy_type)[-300:]
    x = np.concatenate([x.astype(numpy_type), np.nextafter(near, numpy_type(np.inf)), np.nextafter(near, near * 0)])
    x = np.concatenate([x, -x])
    inside = {"exp": abs(x) < 1000, "expm1": abs(x) < 1000, "tanh": abs(x) < 1000, "log": x > 0, "log1p": x > -1}
    return x[inside.get(name, abs(x) <= BOUNDS.get(name, {}).get(precision, 0))]


def units_in_the_last_place(y, x, name: str) -> float:
    """|y - f(x)| in units of the last place of f(x); none where e^x is subnormal and y = 0, or both overflow."""
    limits = np.finfo(y.dtype)
    with mpmath.workprec(200):
        exact = getattr(mpmath, name)(mpmath.mpf(float(x)))
        if (name == "exp" and exact < float(limits.tiny) and y == 0) or exact == float(y):
            return 0.0
        exponent = max(mpmath.frexp(exact)[1] - 1, limits.minexp)
        if exponent >= limits.maxexp or not np.isfinite(y):
            largest = mpmath.mpf(float(limits.max)) + mpmath.ldexp(1, limits.maxexp - limits.nmant - 2)
            return 0.0 if exact >= largest and y == np.inf else np.inf
        return float(abs(mpmath.mpf(float(y)) - exact) * mpmath.ldexp(1, int(limits.nmant - exponent)))


def units_of_single(y, x, name: str) -> np.ndarray:
    """The same for single-precision arrays; double precision is exact enough for them."""
    limits = np.finfo(np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        exact = getattr(np, name)(x.astype(float))
        exponent = np.maximum(np.frexp(exact)[1] - 1, limits.minexp)
        errors = np.ldexp(np.abs(y - exact), limits.nmant - exponent)
    largest = float(limits.max) + 2.0 ** (limits.maxexp - limits.nmant - 2)
    vanishes = (name == "exp") & (exact < float(limits.tiny)) & (y == 0)
    return np.where(vanishes | ((exact >= largest) & (y == np.inf)), 0, errors)


@needs_compiler
@by_precision
@pytest.mark.parametrize("name", VECTORISED)
def test_values_are_right_to_two_units_in_the_last_place(evaluate, name, precision):
    x = points(name, precision)
    fused, unfused = (evaluate(name, x, fused) for fused in (True, False))
    if name in SYMMETRIC:  # then half of the numbers are enough
        for y, reflected in ((fused, evaluate(name, -x)), (unfused, evaluate(name, -x, False))):
            np.testing.assert_array_equal(reflected, SYMMETRIC[name] * y)
        x, fused, unfused = x[x >= 0], fused[x >= 0], unfused[x >= 0]
    # What is the same both ways is compared once: mpmath takes most of the time.
    for y, at in ((fused, x), (unfused[unfused != fused], x[unfused != fused])):
        if precision == "f32":
            errors = units_of_single(y, at, name)
        else:
            errors = [units_in_the_last_place(*pair, name) for pair in zip(y, at, strict=True)]
        assert max(errors, default=0) <= 2, at[np.argmax(errors)]


SYMMETRIC = {"sin": -1, "tanh": -1, "cos": 1}
"""f(-x) / f(x) of the odd and even functions."""
LIMITS = {  # at 0, -0, infinity, -infinity
    "exp": (1, 1, np.inf, 0),
    "expm1": (0.0, -0.0, np.inf, -1),
    "tanh": (0.0, -0.0, 1, -1),
    "sin": (0.0, -0.0, np.nan, np.nan),
    "cos": (1, 1, np.nan, np.nan),
    "log": (-np.inf, -np.inf, np.inf, np.nan),
    "log1p": (0.0, -0.0, np.inf, np.nan),
}


@needs_compiler
@by_precision
@pytest.mark.parametrize("name", VECTORISED)
def test_limits_signs_and_nan(evaluate, name, precision):
    numpy_type = TYPES[precision][0]
    word = {"f64": np.uint64, "f32": np.uint32}[precision]
    # A NaN whose low bits are set must not be mistaken for a count.
    payload = (np.array(np.nan, numpy_type).view(word) + word(0x3F5)).view(numpy_type)
    y = evaluate(name, np.array([0.0, -0.0, np.inf, -np.inf, np.nan, payload], numpy_type))
    np.testing.assert_array_equal(y, np.array([*LIMITS[name], np.nan, np.nan], numpy_type))
    assert [np.signbit(value) for value in y[:2]] == [np.signbit(value) for value in LIMITS[name][:2]]


@needs_compiler
@by_precision
@pytest.mark.parametrize("fused", [False, True])
def test_sine_and_cosine_together_are_those_apart(evaluate, precision, fused):
    numpy_type = TYPES[precision][0]
    x = np.concatenate([points("sin", precision), np.array([0.0, -0.0, np.inf, np.nan, 1e7, -1e30], numpy_type)])
    together = evaluate("sin_cos", x, fused)
    for name, y in zip(("sin", "cos"), together, strict=True):
        np.testing.assert_array_equal(y, evaluate(name, x, fused))
        np.testing.assert_array_equal(np.signbit(y[:-4]), np.signbit(evaluate(name, x, fused)[:-4]))


@needs_compiler
@by_precision
def test_ends_of_the_domain(evaluate, precision):
    numpy_type = TYPES[precision][0]
    np.testing.assert_array_equal(
        evaluate("log1p", np.array([-1, -1.5, -np.inf], numpy_type)), [-np.inf] + 2 * [np.nan]
    )
    limits = np.finfo(numpy_type)
    subnormal = limits.smallest_subnormal
    np.testing.assert_array_equal(evaluate("log", np.array([-subnormal, -1, -limits.max], numpy_type)), 3 * [np.nan])
    ends = np.array([limits.max, -limits.max], numpy_type)
    for name, expected in {"exp": (np.inf, 0), "expm1": (np.inf, -1), "tanh": (1, -1)}.items():
        np.testing.assert_array_equal(evaluate(name, ends), expected)


@needs_gcc
@pytest.mark.skipif(platform.machine() != "x86_64", reason="the vector instructions exist only on x86")
@by_precision
@pytest.mark.parametrize("machine", ["haswell", "skylake-avx512"])
def test_gcc_vectorises_every_loop(tmp_path, precision, machine):
    text, report = tmp_path / "loops.c", tmp_path / "report"
    text.write_text(source(precision))
    flags = [*STRICT, "-O3", f"-march={machine}", f"-fopt-info-vec={report}"]
    compile_c(["-std=c99", *flags, "-c", str(text), "-o", str(tmp_path / "loops.o")], "gcc")
    lines = text.read_text().splitlines()
    numbers = [line.split(":")[1] for line in report.read_text().splitlines() if "loop vectorized" in line]
    heads = [next(line for line in lines[int(number) - 1 :: -1] if line.startswith("static")) for number in numbers]
    assert {re.sub(r".*elementary_(\w+)_each.*", r"\1", head) for head in heads} == set(VECTORISED)


@pytest.mark.skipif(not shutil.which("g++"), reason="there is no g++ on the PATH")
@by_precision
def test_text_is_c_plus_plus_too(tmp_path, precision):
    text = tmp_path / "loops.cpp"
    text.write_text(source(precision))
    compile_c([*STRICT, "-O2", str(text), "-o", str(tmp_path / "loops.so")], "g++")


def test_text_holds_what_is_asked_for():
    assert not definitions([], "f64")
    assert "elementary_choice" in definitions(["choice"], "f64") and "exp" not in definitions(["choice"], "f64")
    assert definitions(["sin", "exp"], "f64") == definitions(iter(("exp", "sin", "exp")), "f64")
    assert "elementary_tanh" not in definitions(["exp"], "f64")
    assert "double" not in definitions(VECTORISED, "f32")


def test_operations_are_those_of_the_formulas():
    # Reduction 7, powers 3, polynomial 9 multiply-adds, the sum 3, infinity added beyond the range 1.
    assert OPERATIONS["exp"] == 7 + 3 + 2 * 9 + 3 + 1
    assert set(OPERATIONS) == set(VECTORISED)
