"""benchmark one-step: microseconds of single calls against test error, for every model and call path.

Every mode of dispatch is timed in its own process.
"""

import json
import re
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.data.splits import Split
from dln_jax.export.c.load import FLAGS, STANDARD, compile_c, load_c
from dln_jax.export.c.run import export_run
from dln_jax.export.low_latency import enable_low_latency, low_latency
from dln_jax.learning.dynamics import problem
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import Adam, GaussNewton
from dln_jax.learning.linear import fit_linear
from dln_jax.learning.objectives import objective_of
from dln_jax.metrics.errors import errors
from dln_jax.metrics.latency import one_step
from dln_jax.precision import data_type
from dln_jax.zoo.descriptions import build
from dln_jax.zoo.run import load, save
from scripts.reports.arm.models import DEPTH, STEPS, TRIGONOMETRIC, WIDTHS, described
from scripts.reports.arm.table import letters, published_split
from scripts.reports.case import Findings
from scripts.reports.predictions import predictions
from scripts.reports.process import called
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
            called(times_of_runs, folders, dispatch, CALLS // 20 if quick else CALLS)
            for _ in range(1 if quick else PROCESSES)
            for dispatch in ("default", "low-latency")
        ]
    rows = []
    for name, answers in zip(names, predicted, strict=True):
        error = errors(answers, sets.test)["torque_mse"]
        rows.append(Row(name, "torque_mse", error, "N^2 m^2"))
        for path, numbers in over_processes([turn[name] for turn in turns]).items():
            rows += rows_of(f"{name}/{path}", numbers)
    return Findings(rows)


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


def over_processes(turns: Sequence[dict[str, dict[str, float]]]) -> dict[str, dict[str, float]]:
    """Medians of the quantities by call path over processes, and the spread of the median call."""
    merged: dict[str, dict[str, float]] = {}
    for path in dict.fromkeys(path for turn in turns for path in turn):
        of_path = [turn[path] for turn in turns if path in turn]
        merged[path] = {key: float(np.median([numbers[key] for numbers in of_path])) for key in of_path[0]}
        if "p50_us" in of_path[0]:
            merged[path]["p50_spread_us"] = float(np.ptp([numbers["p50_us"] for numbers in of_path]))
    return merged


def rows_of(case: str, numbers: dict[str, float]) -> list[Row]:
    """Rows of a call path: quantiles of its calls, or calls per second of a loop in C."""
    if "calls_per_second" in numbers:
        rate, bound = numbers["calls_per_second"], LOOP_BOUNDS.get(case)
        return [Row(case, "inverse_calls_per_second", rate, "1/s", bound=bound, at_least=True)]
    shown = {f"inverse_{key}": numbers[key] for key in ("p50_us", "p99_us", "p999_us", "worst_us", "p50_spread_us")}
    shown["inverse_p99_over_p50"] = numbers["p99_us"] / numbers["p50_us"]
    return [Row(case, key, value, unit_of(key), bound=BOUNDS.get((case, key))) for key, value in shown.items()]


def times_of_runs(folders: Sequence[str], dispatch: str, calls: int) -> dict[str, Any]:
    """Times of inverse dynamics by run and call path, for a process of its own.

    The dispatch "default" leaves jitted functions as they are; "low-latency" calls them without a change of threads,
    with NumPy in and out, and in C.
    """
    if dispatch == "low-latency":
        enable_low_latency()
    test = published_split(letters(None)).test
    states = [array[:STATES] for array in (test.q, test.qd, test.qdd)]
    return {folder.name: times_of(folder, states, dispatch, calls) for folder in map(Path, folders)}


def times_of(folder: Path, states: Sequence[np.ndarray], dispatch: str, calls: int) -> dict[str, Any]:
    """Times of one run by call path."""
    precision = json.loads((folder / "model.json").read_text())["model"]["precision"]
    jitted = jax.jit(load(folder).dynamics.inverse_dynamics)
    host = list(zip(*(array.astype(data_type(precision)) for array in states), strict=True))
    device = [tuple(map(jnp.asarray, state)) for state in host]

    def timed(function: Callable, states: list[tuple]) -> dict[str, float]:
        return one_step(function, states, calls=calls)._asdict()

    if dispatch == "default":
        return {"default-jit": timed(jitted, device)}
    packed = low_latency(jitted, *host[0], numpy=True)
    with tempfile.TemporaryDirectory() as place:
        export_run(folder, Path(place), name=EXPORTED, functions=("inverse_dynamics",))
        return {
            "low-latency-jit": timed(jitted, device),
            "low-latency-numpy": timed(packed, host),
            "c-from-python": timed(load_c(place, name=EXPORTED).inverse_dynamics, host),
            "c-loop": {"calls_per_second": calls_in_c(Path(place), 20 * calls)},
        }


def calls_in_c(place: Path, calls: int) -> float:
    """Inverse-dynamics calls per second of the exported demo's own loop; the best of three runs."""
    demo = place / "demo"
    compile_c([*FLAGS, *STANDARD, *map(str, place.glob("*.c")), "-lm", "-o", str(demo)])
    printed = [subprocess.run([demo, str(calls)], capture_output=True, text=True, check=True).stdout for _ in range(3)]
    return max(float(rate) for text in printed for rate in re.findall(r"inverse_dynamics: (\d+) calls/s", text))
