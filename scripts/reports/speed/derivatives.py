"""Two ways to the derivatives in a structured DeLaN's inverse dynamics, for each number of joints."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.mechanics import natural
from dln_jax.models.lagrangian import cholesky_factor
from dln_jax.nn import differential_mlp as network
from dln_jax.nn.activations import tanh
from dln_jax.types import require_positive
from scripts.reports.case import Case, Findings
from scripts.reports.rows import Row
from scripts.reports.turns import medians_in_turns

SIZES = (1, 2, 4, 7, 12)
BATCHES = {1: "single-call", 512: "training-step-batch-512"}


def cases(*, width: int = 64, repetitions: int = 40) -> list[Case]:
    """One case per number of joints and batch; `InputError` for numbers that are not positive."""
    require_positive(repetitions=repetitions, width=width)
    chosen = {f"d-{d}/{kind}": (d, batch) for d in SIZES for batch, kind in BATCHES.items()}
    return [Case(name, partial(compared, name, *sizes, width, repetitions)) for name, sizes in chosen.items()]


def compared(case: str, d: int, batch: int, width: int, repetitions: int) -> Findings:
    """Median times of both methods, µs, and their ratio."""
    keys = jax.random.split(jax.random.key(0), 3)
    outputs = d * (d + 1) // 2
    layers = tuple(
        network.init(key, (2 * d, width, width, size), dtype=jnp.float32)
        for key, size in zip(keys, (outputs, 1), strict=False)
    )
    states = jax.random.normal(keys[2], (4, batch, d), jnp.float32)

    def compiled(way: Callable) -> Callable:
        def loss(layers, states):
            tau = jax.vmap(lambda q, qd, qdd: way(layers, q, qd, qdd))(*states[:3])
            return jnp.mean((tau - states[3]) ** 2)

        if batch == 1:
            return jax.jit(lambda states: way(layers, *states[:3, 0]))
        return jax.jit(lambda states: jax.grad(loss)(layers, states))

    programs = {"jvp_vjp_us": compiled(by_jvp_and_vjp), "one_pass_us": compiled(by_one_pass)}
    for one, other in zip(*(jax.tree.leaves(program(states)) for program in programs.values()), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-2, atol=1e-3 * float(jnp.max(jnp.abs(one))))
    medians = medians_in_turns(programs, (states,), repetitions=repetitions)
    rows = [Row(case, name, 1e6 * value, "us") for name, value in medians.items()]
    return Findings([*rows, Row(case, "one_pass_over_jvp_vjp", medians["one_pass_us"] / medians["jvp_vjp_us"])])


def by_jvp_and_vjp(layers: tuple, q: Array, qd: Array, qdd: Array) -> Array:
    """tau [d] by the library's own mechanics."""
    factor, potential = layers
    d = q.shape[0]
    system = natural.NaturalSystem(
        lambda q: cholesky_factor(network.value(factor, features(q), activation=tanh), d, shift=2.0, floor=0.1),
        lambda q: network.value(potential, features(q), activation=tanh)[0],
    )
    return natural.forces(system, q, qd, qdd)


def by_one_pass(layers: tuple, q: Array, qd: Array, qdd: Array) -> Array:
    """tau [d] from the networks' own Jacobians, chained by hand through features and factor."""
    d = q.shape[0]
    entries, entries_by_feature = network.value_and_jacobian(layers[0], features(q), activation=tanh)
    _, potential_by_feature = network.value_and_jacobian(layers[1], features(q), activation=tanh)
    feature_slopes = jax.jacfwd(features)(q)
    factor, push = jax.linearize(lambda entries: cholesky_factor(entries, d, shift=2.0, floor=0.1), entries)
    factor_slopes = jax.vmap(push, in_axes=1, out_axes=2)(entries_by_feature @ feature_slopes)
    projected = factor.T @ qd
    factor_rate = factor_slopes @ qd
    momentum_rate = factor @ (factor.T @ qdd + factor_rate.T @ qd) + factor_rate @ projected
    kinetic_force = jnp.einsum("ijk,i,j->k", factor_slopes, qd, projected)
    return momentum_rate - kinetic_force + (potential_by_feature @ feature_slopes)[0]


def features(q: Array) -> Array:
    """cos and sin of revolute joints."""
    return jnp.concatenate([jnp.cos(q), jnp.sin(q)])
