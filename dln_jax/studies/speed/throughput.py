"""benchmark throughput: batched states per second of a structured DeLaN, and against the full-Hessian way."""

from functools import partial

import jax
import jax.numpy as jnp
from jax import Array

from dln_jax.figures.benchmarks import cost_curves
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.natural import NaturalSystem, lagrangian
from dln_jax.metrics.latency import medians_in_turns
from dln_jax.models.delan import make_delan
from dln_jax.scenes.chain import chain
from dln_jax.studies.case import Findings
from dln_jax.studies.report import Row
from dln_jax.types import Lagrangian

BATCHES = (1, 10, 100, 1_000, 10_000, 100_000)
QUICK = (1, 1_000)
SIZES = (2, 4, 7, 12)
HESSIAN_BATCH = 512
NAMES = ("inverse", "forward")


def measure(quick: bool) -> Findings:
    """Inverse and forward dynamics for growing batches; at one batch, the full-Hessian way for growing d."""
    repetitions = 10 if quick else 40
    batches = QUICK if quick else BATCHES
    rows: list[Row] = []
    for batch in batches:
        energies, states = structured(2, batch)
        model = dynamics(energies)
        programs = {
            "inverse": jax.jit(jax.vmap(model.inverse_dynamics)),
            "inverse_again": jax.jit(jax.vmap(model.inverse_dynamics)),
            "forward": jax.jit(jax.vmap(model.forward_dynamics)),
        }
        seconds = medians_in_turns(programs, states, repetitions=repetitions)
        case, noise = f"structured-delan/batch-{batch}", abs(seconds["inverse_again"] / seconds["inverse"] - 1)
        rows += [Row(case, f"{name}_states_per_second", batch / seconds[name], "1/s") for name in NAMES]
        rows.append(Row(case, "noise_of_repetition", noise, "1"))
    rates = {name: [row.value for row in rows if row.quantity.startswith(name)] for name in NAMES}
    rows += [hessian_row(d, repetitions) for d in (SIZES[:1] if quick else SIZES)]
    return Findings(rows, {name: (list(batches), each) for name, each in rates.items()})


titles = {"x": "batch", "y": "states per second", "title": "structured DeLaN, d = 2, 64x64, float32"}
draw = partial(cost_curves, **titles)


def hessian_row(d: int, repetitions: int) -> Row:
    """How many times the states per second of the full-Hessian way."""
    energies, states = structured(d, HESSIAN_BATCH)
    ways = {
        "ours": jax.jit(jax.vmap(dynamics(energies).inverse_dynamics)),
        "full": jax.jit(jax.vmap(by_full_hessian(lagrangian(energies)))),
    }
    seconds = medians_in_turns(ways, states, repetitions=repetitions)
    bound = 4.0 if d == 2 else None
    return Row(f"full-hessian/d-{d}", "speedup", seconds["full"] / seconds["ours"], "1", None, bound, at_least=True)


def structured(d: int, batch: int) -> tuple[NaturalSystem, tuple[Array, ...]]:
    """The energies of a structured DeLaN of two layers of 64, and states (q, qd, qdd), float32."""
    model = make_delan(chain(d).needs, width=64, depth=2)
    keys = jax.random.split(jax.random.key(0), 4)
    states = tuple(jax.random.normal(key, (batch, d), jnp.float32) for key in keys[1:])
    return model.energies(model.init(keys[0])), states


def by_full_hessian(L: Lagrangian):
    """(q, qd, qdd) -> tau by `jax.hessian` over both arguments, as published implementations have it."""

    def inverse_dynamics(q: Array, qd: Array, qdd: Array) -> Array:
        _, (mixed, inertia) = jax.hessian(L, argnums=(0, 1))(q, qd)
        return inertia @ qdd + mixed @ qd - jax.grad(L)(q, qd)

    return inverse_dynamics
