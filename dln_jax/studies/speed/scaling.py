"""benchmark scaling: what a structured DeLaN costs with the number of joints."""

import time

import jax
import jax.numpy as jnp
import numpy as np
import optax
from matplotlib.figure import Figure

from dln_jax.figures.benchmarks import cost_panels
from dln_jax.mechanics.equations import dynamics
from dln_jax.metrics.latency import medians_in_turns, one_step
from dln_jax.models.delan import make_delan
from dln_jax.scenes.chain import chain
from dln_jax.studies.case import Findings
from dln_jax.studies.report import Row

SIZES = (1, 2, 3, 4, 6, 8, 10, 12, 30)
QUICK = (2, 4)
FITTED = (2, 12)
"""Joints between which exponents of growth are fitted."""
BATCH = 512
UNITS = {
    **{"inverse_p50_us": "us", "inverse_p99_us": "us", "inverse_compile_seconds": "s"},
    **{"training_step_ms": "ms", "training_compile_seconds": "s", "training_memory_mib": "MiB"},
}
SHOWN = {
    "one call": ("inverse_p50_us", "µs"),
    "training step": ("training_step_ms", "ms"),
    "compilation of a training step": ("training_compile_seconds", "s"),
    "memory of a training step": ("training_memory_mib", "MiB"),
}


def measure(quick: bool) -> Findings:
    """Latency of single calls, a training step at batch 512, compilation and memory; and how fast each grows."""
    sizes = QUICK if quick else SIZES
    found = {d: cost(d, calls=500 if quick else 4_000, repetitions=10 if quick else 30) for d in sizes}
    rows = [Row(f"structured-delan/d-{d}", *item, UNITS[item[0]]) for d in sizes for item in found[d].items()]
    by_quantity = {name: [each[name] for each in found.values()] for name in UNITS}
    inside = [index for index, d in enumerate(sizes) if FITTED[0] <= d <= FITTED[1]]
    for quantity, values in by_quantity.items():
        slope = np.polyfit(np.log([sizes[i] for i in inside]), np.log([values[i] for i in inside]), 1)[0]
        bound = 2.0 if quantity == "inverse_p50_us" else None
        rows.append(Row("structured-delan/growth", f"{quantity}_exponent", float(slope), "1", None, bound))
    places = list(map(float, sizes))
    return Findings(rows, {title: (places, by_quantity[name], unit) for title, (name, unit) in SHOWN.items()})


def draw(lines: dict) -> Figure:
    """Each cost against the number of joints."""
    panels = {name: {"structured-delan": (sizes, values)} for name, (sizes, values, _) in lines.items()}
    return cost_panels(panels, x="joints", y=[unit for *_, unit in lines.values()])


def cost(d: int, *, calls: int, repetitions: int) -> dict[str, float]:
    """Of d joints."""
    model = make_delan(chain(d).needs, width=64, depth=2)
    parameters = jax.jit(model.init)(jax.random.key(0))
    arrays = jax.random.normal(jax.random.key(1), (4, BATCH, d), jnp.float32)
    states = [tuple(arrays[:3, index]) for index in range(64)]
    single = one_step(jax.jit(dynamics(model.energies(parameters)).inverse_dynamics), states, calls=calls)
    optimiser = optax.adam(1e-3)

    def step(parameters, moments, arrays):
        def loss(parameters):
            tau = jax.vmap(dynamics(model.energies(parameters)).inverse_dynamics)(*arrays[:3])
            return jnp.mean((tau - arrays[3]) ** 2)

        changes, moments = optimiser.update(jax.grad(loss)(parameters), moments)
        return optax.apply_updates(parameters, changes), moments

    arguments = (parameters, optimiser.init(parameters), arrays)
    began = time.perf_counter()
    compiled = jax.jit(step).lower(*arguments).compile()
    seconds = time.perf_counter() - began
    analysis = compiled.memory_analysis()
    memory = analysis.temp_size_in_bytes / 2**20 if analysis else float("nan")
    training = medians_in_turns({"step": compiled}, arguments, repetitions=repetitions)["step"]
    of_a_call = (single.p50_us, single.p99_us, single.compile_seconds)
    return dict(zip(UNITS, (*of_a_call, 1e3 * training, seconds, memory), strict=True))
