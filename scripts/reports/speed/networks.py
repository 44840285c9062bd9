"""Speed of networks: single calls against test error, batches, and growth with the number of joints."""

import json
import re
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from dln_jax.export.c.load import FLAGS, STANDARD, compile_c, load_c
from dln_jax.export.c.run import export_run
from dln_jax.export.low_latency import enable_low_latency, low_latency
from dln_jax.learning.dynamics import problem
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import Adam, GaussNewton
from dln_jax.learning.linear import fit_linear
from dln_jax.learning.objectives import objective_of
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.natural import NaturalSystem, lagrangian
from dln_jax.metrics.errors import errors
from dln_jax.metrics.latency import one_step
from dln_jax.models.lagrangian import make_delan
from dln_jax.precision import data_type
from dln_jax.scenes.pendulums import chain
from dln_jax.types import Lagrangian
from dln_jax.zoo.descriptions import build
from dln_jax.zoo.run import load, save
from scripts.reports.arm.data import published_split
from scripts.reports.arm.models import STEPS, TRIGONOMETRIC, WIDTHS, described
from scripts.reports.predictions import predictions
from scripts.reports.process import called
from scripts.reports.run import Numbers
from scripts.reports.timing import medians_in_turns

WIDE = "structured-delan-64x64"
BATCH = 512


def structured(d: int, batch: int) -> tuple[NaturalSystem, tuple[Array, ...]]:
    """The energies of a structured DeLaN of two layers of 64, and states (q, qd, qdd), float32."""
    model = make_delan(chain(d).needs, width=64, depth=2)
    keys = jax.random.split(jax.random.key(0), 4)
    states = tuple(jax.random.normal(key, (batch, d), jnp.float32) for key in keys[1:])
    return model.energies(model.init(keys[0])), states


def by_full_hessian(L: Lagrangian) -> Callable[[Array, Array, Array], Array]:
    """(q, qd, qdd) -> tau by `jax.hessian` over both arguments, as in published implementations."""

    def inverse_dynamics(q, qd, qdd):
        _, (mixed, inertia) = jax.hessian(L, argnums=(0, 1))(q, qd)
        return inertia @ qdd + mixed @ qd - jax.grad(L)(q, qd)

    return inverse_dynamics


def throughput(
    *,
    batches: tuple[int, ...] = (1, 10, 100, 1_000, 10_000, 100_000),
    joints: tuple[int, ...] = (2, 4, 7, 12),
    repetitions: int = 40,
) -> Numbers:
    """Inverse and forward dynamics by batch; the full-Hessian method by number of joints. In float32."""
    measured: dict[str, dict[str, float]] = {}
    with jax.enable_x64(False):
        for batch in batches:
            energies, states = structured(2, batch)
            model = dynamics(energies)
            ways = {"inverse": model.inverse_dynamics, "forward": model.forward_dynamics}
            programs = {name: jax.jit(jax.vmap(way)) for name, way in ways.items()}
            medians = medians_in_turns(programs, states, repetitions=repetitions)
            rates = {f"{name}_states_per_second": batch / seconds for name, seconds in medians.items()}
            measured[f"throughput/structured-delan/batch-{batch}"] = rates
        for d in joints:
            energies, states = structured(d, BATCH)
            ways = {"ours": dynamics(energies).inverse_dynamics, "full": by_full_hessian(lagrangian(energies))}
            programs = {name: jax.jit(jax.vmap(way)) for name, way in ways.items()}
            medians = medians_in_turns(programs, states, repetitions=repetitions)
            measured[f"throughput/full-hessian/d-{d}"] = {"speedup": medians["full"] / medians["ours"]}
    return measured


def scaling(
    *, joints: tuple[int, ...] = (1, 2, 3, 4, 6, 8, 10, 12, 30), calls: int = 4_000, repetitions: int = 30
) -> Numbers:
    """Single calls, a training step at batch 512 and its compilation, and their exponents of growth from 2 to 12."""
    measured: dict[str, dict[str, float]] = {}
    optimiser = optax.adam(1e-3)
    with jax.enable_x64(False):
        for d in joints:
            model = make_delan(chain(d).needs, width=64, depth=2)
            parameters = jax.jit(model.init)(jax.random.key(0))
            arrays = jax.random.normal(jax.random.key(1), (4, BATCH, d), jnp.float32)
            states = [tuple(arrays[:3, index]) for index in range(64)]
            single = one_step(jax.jit(dynamics(model.energies(parameters)).inverse_dynamics), states, calls=calls)

            def step(parameters, moments, arrays, model=model):
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
            numbers = {"inverse_p50_us": single.p50_us, "training_step_ms": 1e3 * training}
            measured[f"scaling/structured-delan/d-{d}"] = {**numbers, "training_compile_seconds": seconds}
    fitted = [d for d in joints if 2 <= d <= 12]
    growth = {}
    for quantity in ("inverse_p50_us", "training_step_ms", "training_compile_seconds"):
        values = [measured[f"scaling/structured-delan/d-{d}"][quantity] for d in fitted]
        growth[f"{quantity}_exponent"] = np.polyfit(np.log(fitted), np.log(values), 1)[0]
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
    with tempfile.TemporaryDirectory() as place, jax.enable_x64(False):
        for name in models:
            wide, folder = name == WIDE, Path(place) / name
            folder.mkdir()
            kind, width = ("structured-delan", 64) if wide else (name, WIDTHS.get(name))
            precision = "f32" if wide else "f64"
            description = described(kind, sets.train, precision=precision, width=width)
            model = build(description)
            if name == TRIGONOMETRIC:
                parameters = fit_linear(model, sets.train).parameters
            else:
                optimiser = Adam(steps=adam_steps) if wide else GaussNewton(steps=steps)
                parameters = fit(problem(model, sets, objective_of(kind, sets.train)), optimiser).parameters
            save(folder, description, parameters)
            answers = predictions(load(folder).energies, sets.test, jnp.float64)
            measured[f"one-step/{name}"] = {"torque_mse": errors(answers, sets.test)["torque_mse"]}
            folders.append(folder)
        modes = ("default", "low-latency") * processes
        answers = [called(times_of_runs, folders, mode, calls) for mode in modes]
    for name in models:
        for path in answers[0][name] | answers[1][name]:
            turns = [answer[name][path] for answer in answers if path in answer[name]]
            numbers = {f"inverse_{key}": np.median([turn[key] for turn in turns]) for key in turns[0]}
            if "p50_us" in turns[0]:
                numbers["inverse_p50_spread_us"] = np.ptp([turn["p50_us"] for turn in turns])
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
    test = published_split().test
    states = [array[:BATCH] for array in (test.q, test.qd, test.qdd)]
    return {folder.name: times_of(folder, states, dispatch, calls) for folder in map(Path, folders)}


def times_of(folder: Path, states: Sequence[np.ndarray], dispatch: str, calls: int) -> dict[str, dict[str, float]]:
    """Times of one run by call path."""
    precision = json.loads((folder / "model.json").read_text())["model"]["precision"]
    jitted = jax.jit(load(folder).dynamics.inverse_dynamics)
    host = list(zip(*(array.astype(data_type(precision)) for array in states), strict=True))
    device = [tuple(map(jnp.asarray, state)) for state in host]

    def timed(function, states):
        times = one_step(function, states, calls=calls)._asdict()
        return {key: times[key] for key in ("p50_us", "p99_us", "p999_us", "worst_us")}

    if dispatch == "default":
        return {"default-jit": timed(jitted, device)}
    with tempfile.TemporaryDirectory() as place:
        export_run(folder, Path(place), name="model", functions=("inverse_dynamics",))
        demo = Path(place) / "demo"
        compile_c([*FLAGS, *STANDARD, *map(str, Path(place).glob("*.c")), "-lm", "-o", str(demo)])
        command = [demo, str(20 * calls)]
        printed = [subprocess.run(command, capture_output=True, text=True, check=True).stdout for _ in range(3)]
        rates = [float(rate) for text in printed for rate in re.findall(r"inverse_dynamics: (\d+) calls/s", text)]
        return {
            "low-latency-jit": timed(jitted, device),
            "low-latency-numpy": timed(low_latency(jitted, *host[0], numpy=True), host),
            "c-from-python": timed(load_c(place, name="model").inverse_dynamics, host),
            "c-loop": {"calls_per_second": max(rates)},
        }
