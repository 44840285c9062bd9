"""benchmark throughput and scaling: cost of a structured DeLaN of two layers of 64, by batch and by number of joints.

Throughput counts batched states, and is also compared with the full-Hessian method.
"""

import time

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.natural import NaturalSystem, lagrangian
from dln_jax.metrics.latency import one_step
from dln_jax.models.lagrangian import make_delan
from dln_jax.scenes.pendulums import chain
from dln_jax.types import Lagrangian
from scripts.reports.case import Findings
from scripts.reports.rows import Row
from scripts.reports.turns import medians_in_turns

BATCHES = (1, 10, 100, 1_000, 10_000, 100_000)
SIZES = (2, 4, 7, 12)
TRAINING_BATCH = 512
JOINTS = (1, 2, 3, 4, 6, 8, 10, 12, 30)
FITTED = (2, 12)
"""Range of joints for fitting exponents of growth."""
UNITS = {"inverse_p50_us": "us", "training_step_ms": "ms", "training_compile_seconds": "s"}


def measure_throughput(quick: bool) -> Findings:
    """Inverse and forward dynamics by batch; the full-Hessian method by d, at one batch."""
    repetitions = 10 if quick else 40
    rows = []
    for batch in (1, 1_000) if quick else BATCHES:
        energies, states = structured(2, batch)
        model = dynamics(energies)
        programs = {
            "inverse": jax.jit(jax.vmap(model.inverse_dynamics)),
            "forward": jax.jit(jax.vmap(model.forward_dynamics)),
        }
        for name, seconds in medians_in_turns(programs, states, repetitions=repetitions).items():
            rows.append(Row(f"structured-delan/batch-{batch}", f"{name}_states_per_second", batch / seconds, "1/s"))
    for d in SIZES[:1] if quick else SIZES:
        energies, states = structured(d, TRAINING_BATCH)
        ways = {
            "ours": jax.jit(jax.vmap(dynamics(energies).inverse_dynamics)),
            "full": jax.jit(jax.vmap(by_full_hessian(lagrangian(energies)))),
        }
        seconds = medians_in_turns(ways, states, repetitions=repetitions)
        bound, speedup = 4.0 if d == 2 else None, seconds["full"] / seconds["ours"]
        rows.append(Row(f"full-hessian/d-{d}", "speedup", speedup, bound=bound, at_least=True))
    return Findings(rows)


def structured(d: int, batch: int) -> tuple[NaturalSystem, tuple[Array, ...]]:
    """The energies of a structured DeLaN, and states (q, qd, qdd), float32."""
    model = make_delan(chain(d).needs, width=64, depth=2)
    keys = jax.random.split(jax.random.key(0), 4)
    states = tuple(jax.random.normal(key, (batch, d), jnp.float32) for key in keys[1:])
    return model.energies(model.init(keys[0])), states


def by_full_hessian(L: Lagrangian):
    """(q, qd, qdd) -> tau by `jax.hessian` over both arguments, as in published implementations."""

    def inverse_dynamics(q: Array, qd: Array, qdd: Array) -> Array:
        _, (mixed, inertia) = jax.hessian(L, argnums=(0, 1))(q, qd)
        return inertia @ qdd + mixed @ qd - jax.grad(L)(q, qd)

    return inverse_dynamics


def measure_scaling(quick: bool) -> Findings:
    """Latency of single calls, a training step at batch 512 and its compilation, and their exponents of growth."""
    sizes = (2, 4) if quick else JOINTS
    costs = {d: cost(d, calls=500 if quick else 4_000, repetitions=10 if quick else 30) for d in sizes}
    rows = [Row(f"structured-delan/d-{d}", *item, UNITS[item[0]]) for d in sizes for item in costs[d].items()]
    fitted = [d for d in sizes if FITTED[0] <= d <= FITTED[1]]
    for quantity in UNITS:
        slope = np.polyfit(np.log(fitted), np.log([costs[d][quantity] for d in fitted]), 1)[0]
        bound = 2.0 if quantity == "inverse_p50_us" else None
        rows.append(Row("structured-delan/growth", f"{quantity}_exponent", float(slope), bound=bound))
    return Findings(rows)


def cost(d: int, *, calls: int, repetitions: int) -> dict[str, float]:
    """Costs at d joints."""
    model = make_delan(chain(d).needs, width=64, depth=2)
    parameters = jax.jit(model.init)(jax.random.key(0))
    arrays = jax.random.normal(jax.random.key(1), (4, TRAINING_BATCH, d), jnp.float32)
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
    training = medians_in_turns({"step": compiled}, arguments, repetitions=repetitions)["step"]
    return dict(zip(UNITS, (single.p50_us, 1e3 * training, seconds), strict=True))
