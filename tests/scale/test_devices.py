"""Behaviour where JAX computes on something other than the CPU; no such device is needed here."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax import precision, scale
from dln_jax.export.low_latency import enable_low_latency, low_latency
from dln_jax.options import Scaled
from dln_jax.runs.running import run
from dln_jax.types import InputError


@pytest.fixture
def on_gpu(monkeypatch):
    """JAX as it answers where its default device is a GPU."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")


def test_no_options_of_the_cpu_reach_another_compiler(on_gpu, monkeypatch):
    monkeypatch.setattr(precision, "_OPTIONS", {"xla_backend_optimization_level": 1})
    assert precision.quick_compilation() == {}


def test_low_latency_mode_is_refused_with_the_reason(on_gpu):
    with pytest.raises(InputError, match=r"is for the CPU, but JAX computes on gpu.*export C"):
        low_latency(jnp.sin, np.zeros(2))
    before = getattr(jax.config, "jax_platforms")  # noqa: B009
    jax.config.update("jax_platforms", "cuda,cpu")
    try:
        with pytest.raises(InputError, match="JAX computes on cuda"):
            enable_low_latency()
    finally:
        jax.config.update("jax_platforms", before)


def test_advice_where_double_precision_is_slow(on_gpu, monkeypatch):
    for kind, cost, advice in (("f64", 32.0, ["takes 32 times"]), ("f64", 2.0, []), ("f32", 32.0, [])):
        monkeypatch.setattr(scale, "double_precision_cost", lambda cost=cost: cost)
        first, *rest = scale.device_lines(kind)
        assert first == "1 cpu"
        assert all(words in line for words, line in zip(advice, rest, strict=True))


def test_nothing_is_printed_on_a_cpu_and_the_cost_is_a_ratio():
    assert scale.device_lines("f64") == []
    assert 0 < scale.double_precision_cost(64) < 1000


@pytest.mark.parametrize("error", [RuntimeError, AssertionError])
def test_an_unusable_platform_is_one_line(error, monkeypatch, capsys):
    """An AssertionError where JAX knows the platform and has no library for it."""

    def start(*_):
        raise error("Unable to initialize backend")

    assert scale.unusable_platform() is None
    monkeypatch.setattr(jax, "devices", start)
    monkeypatch.setattr(sys, "argv", ["tried"])
    with pytest.raises(SystemExit) as ended:
        run(lambda options: jax.devices(), Scaled, prog="tried")
    assert ended.value.code == 2
    line = capsys.readouterr().err
    assert line.startswith("error: JAX cannot start ") and line.count("\n") == 1
