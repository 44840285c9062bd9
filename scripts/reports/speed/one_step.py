"""benchmark one-step: microseconds of single calls against test error, for every model and call path.

JAX fixes its mode of dispatch when it starts, so every mode is timed in its own process, which runs this module.
"""

import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.cli.running import run
from dln_jax.data.splits import Split
from dln_jax.export.c.load import FLAGS, STANDARD, compile_c, load_c
from dln_jax.export.c.run import export_run
from dln_jax.export.low_latency import enable_low_latency, low_latency
from dln_jax.learning.dynamics import problem
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import Adam, GaussNewton
from dln_jax.learning.linear import fit_linear
from dln_jax.learning.objectives import objective_of
from dln_jax.metrics.errors import errors, predictions
from dln_jax.metrics.latency import one_step
from dln_jax.training.low_latency_calls import last_line
from dln_jax.types import InputError
from dln_jax.zoo.descriptions import build
from dln_jax.zoo.run import load, save
from scripts.reports.arm.models import DEPTH, STEPS, TRIGONOMETRIC, WIDTHS, described
from scripts.reports.arm.table import letters, published_split
from scripts.reports.case import Findings
from scripts.reports.figures.costs import EXACT, cost_points
from scripts.reports.rows import Row, unit_of

WIDE = "structured-delan-64x64"
SMALL = "structured-delan"
BOUNDS = {
    (f"{WIDE}/low-latency-jit", "inverse_p50_us"): 13.0,
    (f"{WIDE}/low-latency-jit", "inverse_p99_over_p50"): 3.0,
    (f"{WIDE}/c-from-python", "inverse_p50_us"): 6.0,
}
LOOP_BOUNDS = {f"{WIDE}/c-loop": 200_000.0, f"{SMALL}/c-loop": 1_500_000.0}
CALLS = 20_000
STATES = 512
EXPORTED = "model"
PROCESSES = 3
"""Processes per mode of dispatch, in turns; medians count, and the spread shows the machine's noise."""


def measure(quick: bool) -> Findings:
    """Trains all models of the arm, and times single calls in separate processes."""
    sets = published_split(letters(None))
    names = (WIDE, TRIGONOMETRIC) if quick else (*WIDTHS, WIDE, TRIGONOMETRIC)
    with tempfile.TemporaryDirectory() as place:
        folders = [train_into(Path(place), name, sets, quick=quick) for name in names]
        predicted = [predictions(load(folder).energies, sets.test, jnp.float64) for folder in folders]
        turns = [
            time_in_a_process(folders, dispatch, calls=CALLS // 20 if quick else CALLS)
            for _ in range(1 if quick else PROCESSES)
            for dispatch in ("default", "low-latency")
        ]
    rows, places = [], {}
    for name, answers in zip(names, predicted, strict=True):
        error = errors(answers, sets.test)["torque_mse"]
        rows.append(Row(name, "torque_mse", error, "N^2 m^2"))
        for path, functions in over_processes([turn[name] for turn in turns]).items():
            rows += rows_of(f"{name}/{path}", functions)
            if "p50_us" in functions["inverse"]:
                places[f"{name}, {path}"] = (functions["inverse"]["p50_us"], error)
    return Findings(rows, places)


draw = partial(
    cost_points,
    **{"x": "one inverse-dynamics call, median, µs", "y": "test torque MSE, (N m)²"},
    **{"title": "two-link arm, single calls", "front": True, "exact": EXACT},
)


def train_into(place: Path, name: str, sets: Split, *, quick: bool) -> Path:
    """Trains a model into a folder: the wide one by Adam, the trigonometric one directly, others by Gauss-Newton."""
    folder = place / name
    folder.mkdir()
    kind, wide = SMALL if name == WIDE else name, name == WIDE
    width, steps, precision = (64, 20_000, "f32") if wide else (WIDTHS.get(kind), STEPS, "f64")
    description = described(kind, sets.train, precision=precision, width=width, depth=DEPTH)
    model = build(description)
    if kind == TRIGONOMETRIC:
        parameters = fit_linear(model, sets.train).parameters
    else:
        optimiser = (Adam if wide else GaussNewton)(steps=max(5, steps // 100) if quick else steps)
        parameters = fit(problem(model, sets, objective_of(kind, sets.train)), optimiser).parameters
    save(folder, description, parameters)
    return folder


def time_in_a_process(folders: list[Path], dispatch: str, *, calls: int) -> dict[str, dict]:
    """The measurements of `main`, by run."""
    command = [sys.executable, "-m", "scripts.reports.speed.one_step", "--dispatch", dispatch, "--calls", str(calls)]
    done = subprocess.run([*command, "--runs", *map(str, folders)], capture_output=True)
    if done.returncode:
        raise InputError(f"timing in a process of its own failed: {last_line(done.stderr)}")
    return json.loads(last_line(done.stdout))


def over_processes(turns: list[dict]) -> dict[str, dict[str, dict[str, float]]]:
    """Medians of the quantities over processes, and the spread of the median call."""
    found: dict[str, dict[str, dict[str, float]]] = {}
    for path in dict.fromkeys(path for turn in turns for path in turn):
        of_path = [turn[path] for turn in turns if path in turn]
        found[path] = {}
        for name in of_path[0]:
            numbers = {key: [each[name][key] for each in of_path] for key in of_path[0][name]}
            found[path][name] = {key: float(np.median(values)) for key, values in numbers.items()}
            if "p50_us" in numbers:
                found[path][name]["p50_spread_us"] = float(np.ptp(numbers["p50_us"]))
    return found


def rows_of(case: str, functions: dict[str, dict[str, float]]) -> list[Row]:
    """Rows of the functions' quantiles."""
    rows = []
    for name, latency in functions.items():
        if "calls_per_second" in latency:
            rate, bound = latency["calls_per_second"], LOOP_BOUNDS.get(case)
            rows.append(Row(case, f"{name}_calls_per_second", rate, "1/s", bound=bound, at_least=True))
            continue
        shown = ("p50_us", "p99_us", "p999_us", "worst_us", "p50_spread_us")
        numbers = {f"{name}_{key}": latency[key] for key in shown}
        numbers[f"{name}_p99_over_p50"] = latency["p99_us"] / latency["p50_us"]
        rows += [Row(case, key, value, unit_of(key), bound=BOUNDS.get((case, key))) for key, value in numbers.items()]
    return rows


@dataclass(frozen=True)
class Arguments:
    """What to time."""

    runs: tuple[Path, ...]
    """Folders of trained runs of the two-link arm."""
    dispatch: Literal["default", "low-latency"] = "default"
    """default: jitted functions as they are; low-latency: without a change of threads, with NumPy in and out, and C."""
    calls: int = 20_000
    """Calls that are timed, of each."""


def main(given: Arguments) -> None:
    """Times, and prints JSON: microseconds by run, call path and function."""
    if given.dispatch == "low-latency":
        enable_low_latency()
    test = published_split(letters(None)).test
    states = {
        "inverse": tuple(array[:STATES] for array in (test.q, test.qd, test.qdd)),
        "forward": tuple(array[:STATES] for array in (test.q, test.qd, test.tau)),
    }
    print(json.dumps({folder.name: times_of(folder, states, given) for folder in given.runs}))


def times_of(folder: Path, states: dict[str, tuple[np.ndarray, ...]], given: Arguments) -> dict[str, Any]:
    """Times of one run by call path and function."""
    precision = json.loads((folder / "model.json").read_text())["model"]["precision"]
    dtype = {"f32": np.float32, "f64": np.float64}[precision]
    system = load(folder).dynamics
    jitted = {"inverse": jax.jit(system.inverse_dynamics), "forward": jax.jit(system.forward_dynamics)}
    host = {name: list(zip(*(array.astype(dtype) for array in states[name]), strict=True)) for name in jitted}
    device = {name: [tuple(map(jnp.asarray, state)) for state in host[name]] for name in jitted}

    def timed(functions: dict[str, Callable], states: dict[str, list[tuple]]) -> dict[str, dict[str, float]]:
        return {name: one_step(each, states[name], calls=given.calls)._asdict() for name, each in functions.items()}

    if given.dispatch == "default":
        return {"default-jit": timed(jitted, device)}
    packed = {name: low_latency(function, *host[name][0], numpy=True) for name, function in jitted.items()}
    found = {"low-latency-jit": timed(jitted, device), "low-latency-numpy": timed(packed, host)}
    with tempfile.TemporaryDirectory() as place:
        export_run(folder, Path(place), name=EXPORTED, functions=("inverse_dynamics", "forward_dynamics"))
        exported = load_c(place, name=EXPORTED)
        functions = {"inverse": exported.inverse_dynamics, "forward": exported.forward_dynamics}
        found["c-from-python"] = timed(functions, host)
        found["c-loop"] = {"inverse": {"calls_per_second": calls_in_c(Path(place), 20 * given.calls)}}
    return found


def calls_in_c(place: Path, calls: int) -> float:
    """Inverse-dynamics calls per second of the exported demo's own loop; the best of three runs."""
    demo = place / "demo"
    compile_c([*FLAGS, *STANDARD, *map(str, place.glob("*.c")), "-lm", "-o", str(demo)])
    printed = [subprocess.run([demo, str(calls)], capture_output=True, text=True, check=True).stdout for _ in range(3)]
    return max(float(rate) for each in printed for rate in re.findall(r"inverse_dynamics: (\d+) calls/s", each))


if __name__ == "__main__":
    run(main, Arguments, prog="python -m scripts.reports.speed.one_step")
