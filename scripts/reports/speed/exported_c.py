"""benchmark c: exported C, called in a warm loop, with cold caches and from Python; its derivatives, rivals and making.

Programs that are compared take turns in one run, in separate processes; medians over turns count, and quantiles of cold
calls are those of all turns. Before a cold call twice the last-level cache is read, 64 MiB at most. Parameters are
random, since times do not depend on them.
"""

import math
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from dln_jax.export.c.families import functions_of_system
from dln_jax.export.c.load import FLAGS, load_c
from dln_jax.export.c.source import export_c
from dln_jax.precision import data_type
from dln_jax.scenes.pendulums import chain
from dln_jax.types import InputError
from dln_jax.zoo.descriptions import build, describe
from scripts.reports.case import Findings
from scripts.reports.robots.pinocchio import RIVALS, Timed, pinocchio_functions, rival_arm, seconds_of_calls
from scripts.reports.rows import Row, expect
from scripts.reports.speed.calls_in_c import Times, compiled, evicting, last_level_cache, programs, timed


class Arm(NamedTuple):
    """A structured DeLaN of a chain of d links, with two layers."""

    width: int
    precision: str
    d: int
    speedup: float | None = None
    """Smallest speed-up of its inverse dynamics over another export."""


ARMS = {
    f"structured-delan-{arm.width}x{arm.width}-{arm.precision}-d-{arm.d}": arm
    for arm in (Arm(8, "f64", 2, 1.2), Arm(64, "f64", 2, 2.0), Arm(64, "f32", 2, 1.3), Arm(8, "f64", 7))
}
SMALLEST, *_, RIVALLED = ARMS
"""The arms of a quick run; the rival gets as many joints as the second."""
LARGEST = {"structured-delan-64x64-f64-d-7": Arm(64, "f64", 7)}
"""An arm that is only exported and compiled."""
FUNCTIONS = INVERSE, FORWARD, JACOBIAN = ("inverse_dynamics", "forward_dynamics", "inverse_dynamics_jacobian")
"""Functions to time, if an export declares them."""
OURS, OTHERS = "ours", "against"
TURNS, QUICK_TURNS = 5, 2
SECONDS = 20.0
"""Time limit for writing and compiling the largest export."""
AGREEMENT = {"f64": 1e-11, "f32": 1e-4}
"""Bound on the relative difference of sums of results of two exports."""


def export(arm: Arm, folder: Path) -> None:
    """Writes the C code of an arm with fixed random parameters, as model.c, .h and .json."""
    needs = chain(arm.d).needs
    description = describe("structured-delan", precision=arm.precision, needs=needs, width=arm.width, depth=2)
    random = np.random.default_rng(0)
    shapes = jax.eval_shape(build(description).init, jax.random.key(0))
    drawn = jax.tree.map(lambda leaf: random.normal(size=leaf.shape) / np.sqrt(leaf.shape[0]), shapes)
    dtype = data_type(arm.precision)
    energies = build(description).energies(jax.tree.map(lambda leaf: leaf.astype(dtype), drawn))
    functions = functions_of_system(energies, arm.d, dtype=dtype)
    export_c(functions, folder, precision=arm.precision, leave_out_large=True)


def export_all(folder: Path) -> None:
    """Exports all arms into folders named after them; another release can measure against them with `--against`."""
    for name, arm in ARMS.items():
        export(arm, folder / name)


def measure(quick: bool, against: Path | None = None) -> Findings:
    """Times all functions of all arms, hot, cold and from Python, against Pinocchio and against another export.

    Args:
        quick: fewer arms, turns and calls.
        against: folder written by `export_all`, such as that of another release.

    Raises:
        InputError: the other export lacks an arm, or something does not compile.
    """
    names = (SMALLEST, RIVALLED) if quick else tuple(ARMS)
    require_exports(against, names)
    effort = {"repeats": 3, "calls": 200, "cold": 50} if quick else {"repeats": 15, "calls": 2_000, "cold": 200}
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as place:
        ours, others = (Path(place) / whose for whose in (OURS, OTHERS))
        making: dict[str, tuple[float, float]] = {}
        every: list[Times] = []
        for name in names:
            making[name] = made(ARMS[name], ours / name)
            timing = {OURS: programs(ours / name, ours / name / "model.o", FUNCTIONS)}
            if against:
                (others / name).mkdir(parents=True)
                timing[OTHERS] = programs(against / name, compiled(against / name, others / name), FUNCTIONS)
            built = {(whose, function): path for whose, paths in timing.items() for function, path in paths.items()}
            turns = [
                {key: timed(program, mebibytes=evicting(), **effort) for key, program in built.items()}
                for _ in range(QUICK_TURNS if quick else TURNS)
            ]
            every += turns[0].values()
            rows += rows_of_calls(name, ARMS[name], {key: [turn[key] for turn in turns] for key in built})
            print(f"{name}: {sum(making[name]):.1f} s to make; {len(built)} functions timed", flush=True)
        loaded = {name: load_c(ours / name) for name in names}
        making |= {name: made(arm, ours / name) for name, arm in LARGEST.items()}
    rows += from_python(loaded, repetitions=20 if quick else 200)
    rows += [row for name, seconds in making.items() for row in rows_of_making(name, seconds, every[0].compiler)]
    rows.append(Row("caches", "emptied_by_mib", evicting(), "MiB", expected="read before each cold call"))
    rows.append(Row("caches", "last_level_mib", last_level_cache() or math.nan, "MiB"))
    rows.append(Row("clock", "subtracted_ns", every[0].timer, "ns", expected="taken off each cold call"))
    return Findings(rows)


def require_exports(against: Path | None, names: Sequence[str]) -> None:
    """Raises `InputError` if the folder, if any, lacks an export of an arm."""
    wanted = [f"{name}/model{suffix}" for name in names for suffix in (".h", ".c")]
    missing = [path for path in wanted if against and not (against / path).is_file()]
    if missing:
        raise InputError(f"{against} lacks {missing[0]}; expected what `exported_c.export_all` wrote there")


def made(arm: Arm, folder: Path) -> tuple[float, float]:
    """Exports an arm and compiles it to model.o in the same folder; returns both times, s."""
    began = time.perf_counter()
    export(arm, folder)
    written = time.perf_counter()
    compiled(folder, folder)
    return written - began, time.perf_counter() - written


def rows_of_making(arm: str, seconds: tuple[float, float], compiler: str) -> list[Row]:
    """Rows of the times returned by `made` and of their sum, which has a bound for the largest export."""
    rows = [Row(arm, f"{what}_seconds", s, "s") for what, s in zip(("export", "compiler"), seconds, strict=True)]
    words = f"export, and {compiler} {' '.join(FLAGS)}"
    bound = SECONDS if arm in LARGEST else None
    return [*rows, Row(arm, "making_seconds", sum(seconds), "s", bound=bound, expected=words)]


def rows_of_calls(name: str, arm: Arm, turns: Mapping[tuple[str, str], Sequence[Times]]) -> list[Row]:
    """Rows of one arm's calls in C, by origin of the code and function; ratios are medians over turns."""
    rows = []
    for (whose, function), times in turns.items():
        case = f"{name}/{function}" if whose == OURS else f"{name}/{function}/{whose}"
        cold = np.percentile(np.concatenate([turn.cold for turn in times]), [50, 99, 99.9])
        of_turns = [hot(turn) for turn in times]
        numbers = [np.median(of_turns), np.ptp(of_turns), *cold]
        names = ("hot", "hot_spread", "cold_p50", "cold_p99", "cold_p999")
        rows += [Row(case, f"{name}_ns", float(number), "ns") for name, number in zip(names, numbers, strict=True)]
        if function == JACOBIAN:
            words, bound = f"d + 3 times the time of {INVERSE}", arm.d + 3.0 if whose == OURS else None
            rows.append(
                Row(case, "over_inverse", ratio(times, turns[whose, INVERSE], hot), bound=bound, expected=words)
            )
        if whose == OURS and (OTHERS, function) in turns:
            others, bound = turns[OTHERS, function], arm.speedup if function == INVERSE else None
            rows.append(Row(case, "speedup", ratio(others, times, hot), bound=bound, at_least=True))
            rows.append(Row(case, "cold_speedup", ratio(others, times, cold_median)))
            difference = abs(times[0].sum / others[0].sum - 1)
            rows.append(Row(case, "relative_difference", difference, bound=AGREEMENT[arm.precision]))
    return rows


def hot(times: Times) -> float:
    """Time of a call in a loop, ns, median over repeats."""
    return float(np.median(times.hot))


def cold_median(times: Times) -> float:
    """Median time of a cold call, ns."""
    return float(np.median(times.cold))


def ratio(one: Sequence[Times], other: Sequence[Times], number: Callable[[Times], float]) -> float:
    """Ratio of the times of one and the other, median over turns."""
    return float(np.median([number(a) / number(b) for a, b in zip(one, other, strict=True)]))


def from_python(exports: Mapping[str, Any], *, repetitions: int) -> list[Row]:
    """Times of calls from Python, µs, of loaded exports by arm and of Pinocchio, and their ratios."""
    functions = {
        f"{name}/{function}": Timed(getattr(loaded, function), ARMS[name].d, data_type(ARMS[name].precision))
        for name, loaded in exports.items()
        for function in RIVALS
    }
    rivals = pinocchio_functions(rival_arm(ARMS[RIVALLED].d)) if RIVALLED in exports else {}
    seconds = seconds_of_calls({**functions, **rivals}, repetitions=repetitions)
    rows = [Row(case, "python_us", 1e6 * seconds[case], "us") for case in functions]
    for function, rival in RIVALS.items():
        if rival in rivals:
            case, words = f"{RIVALLED}/{function}", f"from Python, the time of {rivals[rival].title} for as many joints"
            rows.append(Row(case, "pinocchio_us", 1e6 * seconds[rival], "us"))
            rows.append(expect(case, f"over_{rival}", words, seconds[case] / seconds[rival], 1.0))
    return rows
