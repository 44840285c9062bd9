"""Functions without a C equivalent are refused in one line that says what and where, and nothing is written."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
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


def called_back(x):
    return jax.pure_callback(np.sin, x, x)


def with_effect(x):
    return jax.experimental.io_callback(np.sin, x, x)


def deep(x):
    return jax.jit(lambda y: lax.scan(lambda c, z: (c, special.gammainc(y, z)), 0.0, y)[1])(x)


def convolved(x):
    return jnp.convolve(x, x)


FUNCTIONS = {
    "debug print": (printed, (X,), "(printing|side effect|callback)"),
    "callback": (called_back, (X,), "'pure_callback' is a callback into Python"),
    "callback with effect": (with_effect, (X,), "side effect"),
    "random numbers": (lambda x: x + jax.random.normal(jax.random.key(0), (3,)), (X,), "random numbers"),
    "old random numbers": (lambda x: x + jax.random.uniform(jax.random.PRNGKey(0), (3,)), (X,), "random numbers"),
    "key as argument": (lambda x, key: x * jax.random.normal(key), (X, KEY), "(random numbers|type key)"),
    "half": (lambda x: x * 2, (X.astype(np.float16),), "float16"),
    "half inside": (lambda x: x.astype(jnp.bfloat16).astype(float), (X,), "type bfloat16"),
    "bytes": (lambda x: x + 1, (np.zeros(3, np.int8),), "type int8, which generated C does not have"),
    "complex": (lambda x: jnp.abs(x + 1j), (X,), "type complex128"),
    "complex argument": (lambda x: x.real, (X + 1j,), "type complex128"),
    "inside": (deep, (X,), r"the primitive 'igamma' has no C \(made at .*test_refusals\.py:\d+\)"),
    "fft": (lambda x: jnp.fft.rfft(x).real, (X,), r"('fft' has no C|type complex).*test_refusals\.py:\d+"),
    "convolution": (convolved, (X,), r"'conv_general_dilated' has no C \(made at .*test_refusals\.py:\d+\)"),
    "singular values": (lambda x: jnp.linalg.svd(jnp.outer(x, x))[1], (X,), "'svd' has no C"),
    "pivoted QR": (lambda x: jax.scipy.linalg.qr(jnp.outer(x, x), pivoting=True), (X,), "no C with pivoting=True"),
    "rounded product": (lambda x: lax.dot(x, x, precision="BF16_BF16_F32"), (X,), "precision=.*BF16_BF16_F32"),
    "some eigenvalues": (
        lambda x: lax.linalg.eigh(jnp.outer(x, x), subset_by_index=(0, 2))[1], (X,), "'eigh' has C for all eigenvalues"
    ),
    "factors without elements": (lambda x: jnp.linalg.qr(x[:, None][:, :0], "complete"), (X,), r"shape \(3, 0\)"),
    "stack": (lambda x: jnp.sin(jnp.outer(x, x)).sum(0), (np.zeros(300),), r"KiB of stack; .* 256 KiB"),
    "large array": (lambda x: jnp.sum(jnp.ones(2049)[:, None] * jnp.outer(x, x).ravel()), (np.zeros(64),), "too large"),
    "source": (lambda x: x @ LARGE, (np.zeros(230),), r"source would take 1 MB; .* 1 MB"),
    "no array": (lambda x: x, ("text",), "(type|array)"),
    "same leaves": (lambda a, a_b: a["b"] + a_b, ({"b": 1.0}, 2.0), "two arguments have one name"),
    "same results": (lambda x: {"a": {"b": x}, "a_b": x}, (X,), "two results have one name"),
    "bad argument": (lambda double: 2 * double, (X,), "name of an argument is 'double'"),
    "argument of <math.h>": (lambda sin: 2 * sin, (X,), "name of an argument is 'sin'"),
    "argument of the source": (lambda v3_: 2 * v3_, (X,), "name of an argument is 'v3_'"),
    "bad result": (lambda x: {"while": x}, (X,), "name of a result is 'while'"),
    "result with a space": (lambda x: {"my force": x}, (X,), "name of a result is 'my force'"),
}  # fmt: skip


def test_a_parameter_that_a_rule_does_not_read_is_refused_by_name(tmp_path, monkeypatch):
    monkeypatch.setitem(lowering._RULES, "cumsum", lambda program, node, *, axis: node)
    export_c({"run": (lambda x: lax.cumsum(x, reverse=False), (X,))}, tmp_path / "c")
    with pytest.raises(InputError, match=r"'cumsum' has no C with reverse=True \(made at .*test_refusals\.py:\d+\)"):
        export_c({"run": (lambda x: lax.cumsum(x, reverse=True), (X,))}, tmp_path / "c", overwrite=True)


@pytest.mark.parametrize("case", FUNCTIONS)
def test_a_function_without_c_is_refused(case, tmp_path, monkeypatch):
    function, examples, message = FUNCTIONS[case]
    monkeypatch.setattr(source, "LENGTH", 1_000_000)  # 10 MB take seconds to write
    with pytest.raises(InputError, match=message) as caught:
        export_c({"run": (function, examples)}, tmp_path / "c")
    assert "\n" not in str(caught.value) and not (tmp_path / "c").exists()


NAMES = (
    "math",
    "Math",
    "SIN",
    "sin",
    "double",
    "class",
    "real",
    "cholesky",
    "elementary_sin",
    "table_0",
    "stdio",
    "main",
)
NAMES += ("malloc", "NULL", "NAN", "INFINITY", "errno", "j1", "2x", "a b", "a;b", "", "ä", "x" * 41, "end_", "_start")


@pytest.mark.parametrize("name", NAMES)
def test_names_that_c_or_its_libraries_have_are_refused(name, tmp_path):
    """Names of the export, of a function, and of a result."""
    for options in (
        {"name": name},
        {"functions": {name: (jnp.sin, (X,))}},
        {"functions": {"run": (lambda: {name: jnp.ones(2)}, ())}},
    ):
        if options.get("functions", {}).get("run") and not name[:1].isalpha():
            continue  # a result is named `result` then
        keywords = {"functions": {"run": (jnp.sin, (X,))}, **options}
        with pytest.raises(InputError, match="expected a C name") as caught:
            export_c(keywords.pop("functions"), tmp_path / "c", **keywords)
        assert "\n" not in str(caught.value) and not (tmp_path / "c").exists()


OPTIONS = {
    "no function": ({}, {}, "no function to export"),
    "precision": ({"run": (jnp.sin, (X,))}, {"precision": "f16"}, "precision is 'f16'; expected f32 or f64"),
}


@pytest.mark.parametrize("case", OPTIONS)
def test_what_cannot_be_exported_is_refused(case, tmp_path):
    functions, options, message = OPTIONS[case]
    with pytest.raises(InputError, match=message):
        export_c(functions, tmp_path / "c", **options)
    assert not (tmp_path / "c").exists()
