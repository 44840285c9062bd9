"""Compilation: the time until the first step of a scene, and of a gradient, by what XLA does.

    trace: Python to JAX's program,    lower: to XLA's,    compile: to machine code

Two cores compile in parallel, so that the sum is less than the processor time.
"""

import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from dln_jax.softbody import examples
from dln_jax.softbody.driven import Example
from dln_jax.softbody.step import make_step
from scripts.reports.case import Findings
from scripts.reports.rows import Row, expect
from scripts.reports.soft_bodies.gradients import crawling


def steps(quick: bool) -> Findings:
    """A box that falls on the ground, and a bar that touches itself when it is twisted."""
    rows = _of_step("compile/box-on-ground", examples.drop(dimension=3), 6.0)
    return Findings(rows if quick else rows + _of_step("compile/self-contact", examples.twist(contact=True), 12.0))


def gradient(quick: bool) -> Findings:
    """The gradient of 100 steps of the crawler for everything it depends on."""
    del quick
    loss, at = crawling(100, tolerance=1e-6)
    return Findings(_compiled("compile/crawler-gradient", "100 steps, reverse mode", 5.0, jax.value_and_grad(loss), at))


def _of_step(case: str, example: Example, bound: float) -> list[Row]:
    init, step = make_step(example.scene, example.dt)
    text = f"one step in space, {len(example.scene.mesh.vertices)} vertices"
    return _compiled(case, text, bound, step, example.scene.params, init())


def _compiled(case: str, text: str, bound: float, function: Callable, *arguments: Any) -> list[Row]:
    # With a constant of its own, the program is in no cache.
    stamp = time.time_ns()
    began = time.perf_counter()
    traced = jax.jit(lambda *arguments: (function(*arguments), jnp.asarray(stamp))).trace(*arguments)
    at_trace = time.perf_counter()
    lowered = traced.lower()
    at_lower = time.perf_counter()
    lowered.compile()
    total = time.perf_counter() - began
    parts = f"trace {at_trace - began:.1f}, lower {at_lower - at_trace:.1f}, compile {total + began - at_lower:.1f} s"
    return [expect(case, "seconds", f"{text}; {parts}", total, bound, "s")]
