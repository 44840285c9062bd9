"""Functions without a C equivalent are refused in one line that says what and where, and nothing is written."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from jax import lax
from jax.scipy import special

from dln_jax.export.c import lowering, source
from dln_jax.export.c.source import export_c
from dln_jax.types import InputError

X = np.array([0.3, -0.2, 0.5])
KEY = jax.random.key(0)
LARGE = np.random.default_rng(0).normal(size=(230, 230))


def printed(x):
    jax.debug.print("{}", x)
    return x


def deep(x):
    return jax.jit(lambda y: lax.scan(lambda c, z: (c, special.gammainc(y, z)), 0.0, y)[1])(x)


HERE = r"\(made at .*test_refusals\.py:\d+\)"
ON_THREE = {
    "debug print": (printed, "(printing|side effect|callback)"),
    "callback": (lambda x: jax.pure_callback(np.sin, x, x), "'pure_callback' is a callback into Python"),
    "random numbers": (lambda x: x + jax.random.normal(jax.random.key(0), (3,)), "random numbers"),
    "half inside": (lambda x: x.astype(jnp.bfloat16).astype(float), "type bfloat16"),
    "inside": (deep, f"the primitive 'igamma' is not supported in C {HERE}"),
    "fft": (lambda x: jnp.fft.rfft(x).real, f"('fft' is not supported|type complex).*{HERE}"),
    "convolution": (lambda x: jnp.convolve(x, x), f"'conv_general_dilated' is not supported in C {HERE}"),
    "pivoted QR": (lambda x: jax.scipy.linalg.qr(jnp.outer(x, x), pivoting=True), "in C with pivoting=True"),
    "rounded product": (lambda x: lax.dot(x, x, precision="BF16_BF16_F32"), "precision=.*BF16_BF16_F32"),
    "some eigenvalues": (
        lambda x: lax.linalg.eigh(jnp.outer(x, x), subset_by_index=(0, 2))[1],
        "in C only for all eigenvalues",
    ),
    "factors without elements": (lambda x: jnp.linalg.qr(x[:, None][:, :0], "complete"), r"shape \(3, 0\)"),
    "same results": (lambda x: {"a": {"b": x}, "a_b": x}, "list of results names 'a_b' twice"),
    "branch of Python": (lambda x: x if x[0] > 0 else -x, "use jnp.where or lax.cond"),
    "argument of the source": (lambda v3_: 2 * v3_, "argument name is 'v3_'"),
}
FUNCTIONS = {
    **{case: (function, (X,), message) for case, (function, message) in ON_THREE.items()},
    "key as argument": (lambda x, key: x * jax.random.normal(key), (X, KEY), "(random numbers|type key)"),
    "half": (lambda x: x * 2, (X.astype(np.float16),), "float16"),
    "complex argument": (lambda x: x.real, (X + 1j,), "type complex128"),
    "stack": (lambda x: jnp.sin(jnp.outer(x, x)).sum(0), (np.zeros(300),), r"KiB of stack; .* 256 KiB"),
    "large array": (lambda x: jnp.sum(jnp.ones(2049)[:, None] * jnp.outer(x, x).ravel()), (np.zeros(64),), "too large"),
    "source": (lambda x: x @ LARGE, (np.zeros(230),), r"source needs 1 MB; .* 1 MB"),
    "no array": (lambda x: x, ("text",), "(type|array)"),
    "no tuple": (lambda x: x, X, "one example for each argument"),
    "same leaves": (lambda a, a_b: a["b"] + a_b, ({"b": 1.0}, 2.0), "list of arguments names 'a_b' twice"),
}


def test_a_function_without_c_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(source, "LENGTH", 1_000_000)  # 10 MB take seconds to write
    for case, (function, examples, message) in FUNCTIONS.items():
        with one_line(message):
            export_c({"run": (function, examples)}, tmp_path / "c")
        assert not (tmp_path / "c").exists(), case


def test_a_parameter_that_a_rule_does_not_read_is_refused_by_name(tmp_path, monkeypatch):
    monkeypatch.setitem(lowering._RULES, "cumsum", lambda program, node, *, axis: node)
    export_c({"run": (lambda x: lax.cumsum(x, reverse=False), (X,))}, tmp_path / "c")
    with pytest.raises(InputError, match=f"'cumsum' is not supported in C with reverse=True {HERE}"):
        export_c({"run": (lambda x: lax.cumsum(x, reverse=True), (X,))}, tmp_path / "c", overwrite=True)


NAMES = "math Math SIN double class real cholesky elementary_sin table_0 stdio main malloc NULL NAN errno j1 2x a;b"


def test_names_that_c_or_its_libraries_have_are_refused(tmp_path):
    """Names of the export, of a function, and of a result."""
    sine = {"run": (jnp.sin, (X,))}
    for name in [*NAMES.split(), "", "a b", "ä", "x" * 41, "end_", "_start"]:
        cases = [(sine, name), ({name: sine["run"]}, "model")]
        if name[:1].isalpha():  # a result is named `result` otherwise
            cases.append(({"run": (lambda name=name: {name: jnp.ones(2)}, ())}, "model"))
        for functions, of_export in cases:
            with one_line("expected a C name"):
                export_c(functions, tmp_path / "c", name=of_export)
    with one_line("no function to export"):
        export_c({}, tmp_path / "c")
    with one_line("precision is 'f16'; expected f32 or f64"):
        export_c(sine, tmp_path / "c", precision="f16")
    assert not (tmp_path / "c").exists()
