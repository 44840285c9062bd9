"""Elementary functions of exported C against long double, and what a compiler makes of them."""

import ctypes
import functools
import platform
import re

import comparison
import numpy as np
import pytest
from comparison import needs_gcc
from compilers import needs_compiler

from dln_jax.export.c.elementary import VECTORISED, definitions
from dln_jax.export.c.load import FLAGS, compile_c

STRICT = ("-pedantic", *comparison.STRICT, "-fPIC", "-shared")
TYPES = {"f64": (np.float64, "double", ""), "f32": (np.float32, "float", "f")}
BOUND = {"f64": 2e5, "f32": 1e4}
"""Largest |x| of sine and cosine; beyond it C calls <math.h>."""
by_precision = pytest.mark.parametrize("precision", TYPES)


def source(precision):
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
        "#define RESTRICT restrict\n"
        f"{definitions(['sin_cos'], precision, arrays=VECTORISED)}{loops}"
    )


@pytest.fixture(scope="module")
def evaluate(tmp_path_factory):
    """(name, x, fused) -> y of the compiled function, at the precision of x."""
    folder = tmp_path_factory.mktemp("elementary")

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


def points(name, precision):
    """Random numbers of every third binade where the function is defined and not constant, and the hard ones."""
    real, random = TYPES[precision][0], np.random.default_rng(VECTORISED.index(name))
    limits, bound = np.finfo(real), BOUND[precision] if name in ("sin", "cos") else 1000
    exponents = [*range(limits.minexp - limits.nmant, limits.maxexp, 3), *np.arange(-6, 18).repeat(30)]
    # Thresholds: of the overflow of exp and the smallest normal number, and where tanh and expm1 become constant.
    hard = [*np.log([limits.max, 1 / limits.tiny]), 0.55, 20.0, 40.0, 0.5, 1.0, 2.0, np.sqrt(0.5)]
    if name in ("sin", "cos"):
        # 161 pi/2 and 29 pi/2 are the multiples nearest to a float and a double within the bounds.
        multiples = [
            *range(1, 30),
            *np.outer([29, 161], 2 ** np.arange(12)).flat,
            *random.integers(1, int(bound / 2), 200),
        ]
        hard += [*np.pi / 2 * np.array(multiples), bound]
    near = np.array(hard, real)
    x = np.ldexp(random.uniform(1, 2, len(exponents)), exponents).astype(real)
    x = np.concatenate([x, near, np.nextafter(near, real(np.inf)), np.nextafter(near, real(0))])
    x = np.concatenate([x, -x])
    return x[(x > {"log": 0, "log1p": -1}.get(name, -np.inf)) & ((abs(x) <= bound) | (name in ("log", "log1p")))]


def units_in_the_last_place(y, x, name):
    """|y - f(x)| in units of the last place of f(x); none where e^x is subnormal and y = 0, or both overflow."""
    limits = np.finfo(y.dtype)
    with np.errstate(all="ignore"):
        exact = getattr(np, name)(x.astype(np.longdouble))
        exponent = np.maximum(np.frexp(exact)[1] - 1, limits.minexp)
        errors = np.ldexp(np.abs(y - exact), limits.nmant - exponent)
        largest = np.longdouble(limits.max) + 2.0 ** (limits.maxexp - limits.nmant - 2)
    vanishes = (name == "exp") & (exact < float(limits.tiny)) & (y == 0)
    return np.where(vanishes | ((exact >= largest) & (y == np.inf)), 0, errors)


@needs_compiler
@by_precision
def test_values_are_right_to_two_units_in_the_last_place(evaluate, precision):
    for name in VECTORISED:
        x = points(name, precision)
        for fused in (True, False):
            errors = units_in_the_last_place(evaluate(name, x, fused), x, name)
            assert max(errors) <= 2, (name, fused, x[np.argmax(errors)])


LIMITS = {  # at 0, -0, infinity, -infinity, the largest number, and minus that
    "exp": (1, 1, np.inf, 0, np.inf, 0),
    "expm1": (0.0, -0.0, np.inf, -1, np.inf, -1),
    "tanh": (0.0, -0.0, 1, -1, 1, -1),
    "sin": (0.0, -0.0, np.nan, np.nan),
    "cos": (1, 1, np.nan, np.nan),
    "log": (-np.inf, -np.inf, np.inf, np.nan),
    "log1p": (0.0, -0.0, np.inf, np.nan),
}


@needs_compiler
@by_precision
def test_limits_signs_and_ends_of_the_domain(evaluate, precision):
    real, word = TYPES[precision][0], {"f64": np.uint64, "f32": np.uint32}[precision]
    # A NaN whose low bits are set must not be mistaken for a count.
    payload = (np.array(np.nan, real).view(word) + word(0x3F5)).view(real)
    largest = np.finfo(real).max
    for name, limits in LIMITS.items():
        x = [0.0, -0.0, np.inf, -np.inf, largest, -largest][: len(limits)]
        y = evaluate(name, np.array([*x, np.nan, payload], real))
        np.testing.assert_array_equal(y, np.array([*limits, np.nan, np.nan], real), err_msg=name)
        np.testing.assert_array_equal(np.signbit(y[:2]), np.signbit(limits[:2]), err_msg=name)
    np.testing.assert_array_equal(evaluate("log1p", np.array([-1, -1.5], real)), [-np.inf, np.nan])
    below = np.array([-np.finfo(real).smallest_subnormal, -1, -largest], real)
    np.testing.assert_array_equal(evaluate("log", below), 3 * [np.nan])


@needs_compiler
@by_precision
def test_sine_and_cosine_together_are_those_apart(evaluate, precision):
    more = np.array([0.0, -0.0, np.inf, np.nan, 1e7, -1e30], TYPES[precision][0])
    x = np.concatenate([points("sin", precision), more])
    for fused in (False, True):
        for name, y in zip(("sin", "cos"), evaluate("sin_cos", x, fused), strict=True):
            np.testing.assert_array_equal(y, evaluate(name, x, fused))
            np.testing.assert_array_equal(np.signbit(y[:-4]), np.signbit(evaluate(name, x, fused)[:-4]))


@needs_gcc
@pytest.mark.skipif(platform.machine() != "x86_64", reason="the vector instructions exist only on x86")
@pytest.mark.parametrize("precision, machine", [("f64", "haswell"), ("f32", "skylake-avx512")])
def test_gcc_vectorises_every_loop(tmp_path, precision, machine):
    text, report = tmp_path / "loops.c", tmp_path / "report"
    text.write_text(source(precision))
    flags = [*STRICT, "-O3", f"-march={machine}", "-DDLN_OWN_ELEMENTARY", f"-fopt-info-vec={report}"]
    compile_c(["-std=c99", *flags, "-c", str(text), "-o", str(tmp_path / "loops.o")], "gcc")
    lines = text.read_text().splitlines()
    numbers = [line.split(":")[1] for line in report.read_text().splitlines() if "loop vectorized" in line]
    heads = [next(line for line in lines[int(number) - 1 :: -1] if line.startswith("static")) for number in numbers]
    assert {re.sub(r".*elementary_(\w+)_each.*", r"\1", head) for head in heads} == set(VECTORISED)
