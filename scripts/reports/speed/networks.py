"""Speed of networks: single calls against test error, batches, growth with the number of joints, and derivatives."""

import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.data.schema import from_arrays
from dln_jax.data.splits import Split, select
from dln_jax.export.c.load import load_c
from dln_jax.export.c.source import export_c
from dln_jax.export.functions import functions_of_run
from dln_jax.export.low_latency import enable_low_latency
from dln_jax.learning.dynamics import problem
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import Adam, GaussNewton
from dln_jax.learning.linear import fit_linear
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.natural import NaturalSystem, lagrangian
from dln_jax.metrics.latency import one_step
from dln_jax.models.model import Model, cholesky_factor, make_delan
from dln_jax.nn import differential_mlp
from dln_jax.nn.activations import tanh
from dln_jax.scenes.pendulums import chain
from dln_jax.types import Lagrangian
from dln_jax.zoo.descriptions import build
from dln_jax.zoo.run import load, save
from scripts.reports.arm.data import published_split
from scripts.reports.arm.models import STEPS, TRIGONOMETRIC, WIDTHS, described, torque_mse, trained
from scripts.reports.run import Numbers
from scripts.reports.speed.exported_c import compiled, programs, timed
from scripts.reports.timing import called, medians_in_turns

WIDE = "structured-delan-64x64"
BATCH = 512


def throughput(
    *,
    batches: tuple[int, ...] = (1, 10, 100, 1_000, 10_000, 100_000),
    joints: tuple[int, ...] = (2, 4, 7, 12),
    repetitions: int = 40,
) -> Numbers:
    """Inverse dynamics by batch; the full-Hessian method by number of joints. In float32."""

    def seconds(d, batch, *ways: Callable[[NaturalSystem], Callable]):
        model = make_delan(chain(d).needs, width=64, depth=2)
        keys = jax.random.split(jax.random.key(0), 4)
        states = tuple(jax.random.normal(key, (batch, d), jnp.float32) for key in keys[1:])
        energies = model.energies(model.init(keys[0]))
        programs = {str(number): jax.jit(jax.vmap(way(energies))) for number, way in enumerate(ways)}
        return list(medians_in_turns(programs, states, repetitions=repetitions).values())

    def ours(energies):
        return dynamics(energies).inverse_dynamics

    measured: dict[str, dict[str, float]] = {}
    with jax.enable_x64(False):
        for batch in batches:
            (time,) = seconds(2, batch, ours)
            measured[f"throughput/structured-delan/batch-{batch}"] = {"inverse_states_per_second": batch / time}
        for d in joints:
            time, full = seconds(d, BATCH, ours, lambda energies: by_full_hessian(lagrangian(energies)))
            measured[f"throughput/full-hessian/d-{d}"] = {"speedup": full / time}
    return measured


def by_full_hessian(L: Lagrangian) -> Callable[[Array, Array, Array], Array]:
    """(q, qd, qdd) -> tau by `jax.hessian` over both arguments, as in published implementations."""

    def inverse_dynamics(q, qd, qdd):
        _, (mixed, inertia) = jax.hessian(L, argnums=(0, 1))(q, qd)
        return inertia @ qdd + mixed @ qd - jax.grad(L)(q, qd)

    return inverse_dynamics


def scaling(
    *, joints: tuple[int, ...] = (1, 2, 3, 4, 6, 8, 10, 12, 30), calls: int = 4_000, repetitions: int = 200
) -> Numbers:
    """Single calls, a training step at batch 512 and its compilation, and their exponents of growth from 2 to 12.

    Models and data are in float32; `repetitions` are the steps of a training.
    """
    measured: dict[str, dict[str, float]] = {}
    optimiser = Adam(steps=repetitions, batch=BATCH, steps_per_dispatch=repetitions)
    for d in joints:
        states = np.random.default_rng(0).normal(size=(4, 2 * BATCH, d))
        places = {"t": np.zeros(2 * BATCH), "trajectory": np.arange(2 * BATCH)}
        data = from_arrays({**places, **dict(zip(("q", "qd", "qdd", "tau"), states, strict=True))})
        few = select(data, range(8))
        model = make_delan(chain(d).needs, width=64, depth=2)
        training = fit(problem(model, Split(data, few, few)), optimiser)
        inverse = jax.jit(dynamics(model.energies(training.parameters)).inverse_dynamics)
        single = list(zip(*jnp.asarray(states[:3, :64], jnp.float32), strict=True))
        measured[f"scaling/structured-delan/d-{d}"] = {
            "inverse_p50_us": one_step(inverse, single, calls=calls).p50_us,
            "training_step_ms": 1e3 * training.train_seconds / repetitions,
            "training_compile_seconds": training.compile_seconds,
        }
    fitted = {d: measured[f"scaling/structured-delan/d-{d}"] for d in joints if 2 <= d <= 12}
    growth = {
        f"{quantity}_exponent": np.polyfit(np.log(list(fitted)), np.log([row[quantity] for row in fitted.values()]), 1)[
            0
        ]
        for quantity in next(iter(fitted.values()))
    }
    return {**measured, "scaling/structured-delan/growth": growth}


def single_calls(
    *,
    models: tuple[str, ...] = (*WIDTHS, WIDE, TRIGONOMETRIC),
    calls: int = 20_000,
    processes: int = 3,
    adam_steps: int = 20_000,
    steps: int = STEPS,
) -> Numbers:
    """Trains models of the arm, and times single calls; processes of both modes of dispatch take turns."""
    sets, measured, folders = published_split(), {}, []
    with tempfile.TemporaryDirectory() as place:
        for name in models:
            folder = Path(place) / name
            folder.mkdir()
            if name == WIDE:
                description = described("structured-delan", sets.train, precision="f32", width=64)
            else:
                description = described(name, sets.train)
            if name == TRIGONOMETRIC:
                parameters = fit_linear(build(description), sets.train).parameters
            else:
                optimiser = Adam(steps=adam_steps) if name == WIDE else GaussNewton(steps=steps)
                parameters = trained(description, sets, optimiser)[1].parameters
            save(folder, description, parameters)
            measured[f"one-step/{name}"] = {"torque_mse": torque_mse(load(folder).energies, sets.test)}
            folders.append(folder)
        answers = [called(times_of_runs, folders, mode, calls) for mode in ("default", "low-latency") * processes]
    for name in models:
        for path in answers[0][name] | answers[1][name]:
            turns = [answer[name][path] for answer in answers if path in answer[name]]
            numbers = {f"inverse_{key}": np.median([turn[key] for turn in turns]) for key in turns[0]}
            if "p50_us" in turns[0]:
                numbers["inverse_p99_over_p50"] = numbers["inverse_p99_us"] / numbers["inverse_p50_us"]
            measured[f"one-step/{name}/{path}"] = numbers
    return measured


def times_of_runs(folders: Sequence[str], dispatch: str, calls: int) -> dict[str, Any]:
    """Times of inverse dynamics by run and call path, for a process of its own.

    The dispatch "default" leaves jitted functions as they are; "low-latency" calls them without a change of threads,
    with NumPy in and out, and in C.
    """
    if dispatch == "low-latency":
        enable_low_latency()
    return {folder.name: times_of(folder, dispatch, calls) for folder in map(Path, folders)}


def times_of(folder: Path, dispatch: str, calls: int) -> dict[str, dict[str, float]]:
    """Times of one run by call path."""
    run, test = load(folder), published_split().test
    jitted = jax.jit(run.dynamics.inverse_dynamics)
    states = (array[:BATCH].astype(run.dtype) for array in (test.q, test.qd, test.qdd))
    host = list(zip(*states, strict=True))
    device = [tuple(map(jnp.asarray, state)) for state in host]

    def times(function, states):
        latency = one_step(function, states, calls=calls)
        return {"p50_us": latency.p50_us, "p99_us": latency.p99_us}

    if dispatch == "default":
        return {"default-jit": times(jitted, device)}
    with tempfile.TemporaryDirectory() as place:
        export, name = Path(place), "inverse_dynamics"
        export_c(functions_of_run(run, names=[name]), export)
        loop = timed(
            programs(export, compiled(export, export), [name])[name], repeats=3, calls=20 * calls, cold=0, mebibytes=0
        )
        return {
            "low-latency-jit": times(jitted, device),
            "c-from-python": times(load_c(place, name="model").inverse_dynamics, host),
            "c-loop": {"calls_per_second": 1e9 / min(loop.hot)},
        }


def derivatives(*, width: int = 64, repetitions: int = 40) -> Numbers:
    """Two ways to the derivatives in a structured DeLaN's inverse dynamics, by number of joints, in float32.

    The library's own, which `mechanics.natural` explains, and all partial derivatives of both networks in one pass.
    """
    numbers = {}
    for d in (1, 2, 4, 7, 12):
        model = make_delan(chain(d).needs, width=width, depth=2)
        parameters = model.init(jax.random.key(0))
        ways = {
            "jvp_vjp_us": partial(by_jvp_and_vjp, model),
            "one_pass_us": by_one_pass,
        }
        for batch, kind in {1: "single-call", BATCH: "training-step-batch-512"}.items():
            states = jax.random.normal(jax.random.key(1), (4, batch, d), jnp.float32)
            programs = {name: derivative_program(way, batch) for name, way in ways.items()}
            answers = (jax.tree.leaves(program(parameters, states)) for program in programs.values())
            for one, other in zip(*answers, strict=True):
                np.testing.assert_allclose(one, other, rtol=1e-2, atol=1e-3 * float(jnp.max(jnp.abs(one))))
            medians = medians_in_turns(programs, (parameters, states), repetitions=repetitions)
            numbers[f"d-{d}/{kind}"] = {
                **{name: 1e6 * value for name, value in medians.items()},
                "one_pass_over_jvp_vjp": medians["one_pass_us"] / medians["jvp_vjp_us"],
            }
    return numbers


def derivative_program(way: Callable, batch: int) -> Callable:
    """A single call of the inverse dynamics, or the gradient of a torque loss, of (parameters, states)."""

    def loss(parameters, states):
        tau = jax.vmap(partial(way, parameters))(*states[:3])
        return jnp.mean((tau - states[3]) ** 2)

    if batch == 1:
        return jax.jit(lambda parameters, states: way(parameters, *states[:3, 0]))
    return jax.jit(jax.grad(loss))


def by_jvp_and_vjp(model: Model, parameters, *state: Array) -> Array:
    """tau [d] by the library's own mechanics."""
    return dynamics(model.energies(parameters)).inverse_dynamics(*state)


def by_one_pass(parameters, q: Array, qd: Array, qdd: Array) -> Array:
    """tau [d] of a structured DeLaN from the networks' own Jacobians, chained by hand through features and factor."""

    def features(q):
        return jnp.concatenate([jnp.cos(q), jnp.sin(q)])

    def value_and_jacobian(name):
        modules = (parameters[f"{name}/~/linear_{layer}"] for layer in range(3))
        layers = tuple((module["w"], module["b"]) for module in modules)
        return differential_mlp.value_and_jacobian(layers, features(q), activation=tanh)

    entries, entries_by_feature = value_and_jacobian("cholesky")
    _, potential_by_feature = value_and_jacobian("potential")
    feature_slopes = jax.jacfwd(features)(q)
    factor, push = jax.linearize(lambda entries: cholesky_factor(entries, len(q), shift=2.0, floor=0.1), entries)
    factor_slopes = jax.vmap(push, in_axes=1, out_axes=2)(entries_by_feature @ feature_slopes)
    projected = factor.T @ qd
    factor_rate = factor_slopes @ qd
    momentum_rate = factor @ (factor.T @ qdd + factor_rate.T @ qd) + factor_rate @ projected
    kinetic_force = jnp.einsum("ijk,i,j->k", factor_slopes, qd, projected)
    return momentum_rate - kinetic_force + (potential_by_feature @ feature_slopes)[0]
