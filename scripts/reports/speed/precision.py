"""benchmark precision: float32 against float64, error and time, for every kind of model with the same parameters."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.learning.linear import fit_linear
from dln_jax.mechanics.equations import dynamics
from dln_jax.metrics.latency import medians_in_turns
from dln_jax.zoo.descriptions import build
from dln_jax.zoo.run import compiled
from scripts.reports.arm.models import TRIGONOMETRIC, described
from scripts.reports.arm.table import letters, published_split
from scripts.reports.case import Findings
from scripts.reports.figures.costs import cost_points
from scripts.reports.rows import Row

BATCH = 1_000
INPUTS = {"inverse": ("q", "qd", "qdd"), "forward": ("q", "qd", "tau")}
MEASURED = ("structured-delan", "black-box-delan", "structured-hnn", "feed-forward", TRIGONOMETRIC)
"""Models; not black-box-hnn, since a random energy need not have a momentum for every velocity."""


def measure(quick: bool) -> Findings:
    """Largest difference of float32 from float64, relative to the largest value, and batches of 1,000 in both."""
    data = published_split(letters(None)).train
    rows, shown = [], {}
    for kind in ("structured-delan",) if quick else MEASURED:
        answers, seconds = {}, {}
        model = {p: build(described(kind, data, precision=p, width=64, depth=2)) for p in ("f32", "f64")}
        # A linear model starts at zero, which has no dynamics, so it gets its fitted parameters instead.
        linear = kind == TRIGONOMETRIC
        start = fit_linear(model["f32"], data).parameters if linear else jax.jit(model["f32"].init)(jax.random.key(0))
        # float32 parameters are exact in float64, so that only the arithmetic differs.
        narrow = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), start)
        for precision, dtype in (("f32", jnp.float32), ("f64", jnp.float64)):
            parameters = jax.tree.map(lambda leaf, dtype=dtype: leaf.astype(dtype), narrow)
            system = compiled(dynamics(model[precision].energies(parameters)), dtype)
            for name, chosen in INPUTS.items():
                program = jax.jit(jax.vmap(getattr(system, f"{name}_dynamics")))
                arguments = tuple(jnp.asarray(getattr(data, key)[:BATCH], dtype) for key in chosen)
                answers[precision, name] = np.asarray(program(*arguments), np.float64)
                found = medians_in_turns({name: program}, arguments, repetitions=10 if quick else 40)
                seconds[precision, name] = found[name]
        for name in INPUTS:
            exact = answers["f64", name]
            error = float(np.max(np.abs(answers["f32", name] - exact)) / np.max(np.abs(exact)))
            speed = seconds["f64", name] / seconds["f32", name]
            rows += [
                Row(f"{kind}/{name}", "float32_error", error, "1"),
                Row(f"{kind}/{name}", "float32_speedup", speed, "1"),
                *(Row(f"{kind}/{name}", f"{p}_batch_us", 1e6 * seconds[p, name], "us") for p in ("f32", "f64")),
            ]
            shown[f"{kind}, {name}"] = (speed, error)
    return Findings(rows, shown)


labels = {"x": "time of float64 over time of float32, batch 1,000", "y": "largest relative error of float32"}
draw = partial(cost_points, **labels, title="float32 against float64, 64x64, d = 2")
