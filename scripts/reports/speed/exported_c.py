"""Exported C: calls in a warm loop, with cold caches and from Python, beside Pinocchio's and CasADi's C.

Programs that are compared take turns in one run, in separate processes, and medians over turns count. Before a cold
call twice the last-level cache is read, 64 MiB at most. Parameters are random, since times do not depend on them.
"""

import json
import math
import subprocess
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.export.c.interface import Signature, read_interface, stated_costs
from dln_jax.export.c.load import FLAGS, STANDARD, compile_c, load_c
from dln_jax.export.c.source import export_c
from dln_jax.export.functions import functions_of_system
from dln_jax.mechanics.discrete import linearised
from dln_jax.mechanics.integrators import rk4
from dln_jax.precision import data_type
from dln_jax.scenes.pendulums import chain, two_link_arm
from dln_jax.zoo.descriptions import build, describe
from scripts.reports.control import problems
from scripts.reports.run import Numbers
from scripts.reports.timing import casadi

PROGRAM = Path(__file__).with_name("time_calls.c.in").read_text()
ARMS = {
    "structured-delan-8x8-f64-d-2": (8, "f64", 2),
    "structured-delan-64x64-f64-d-2": (64, "f64", 2),
    "structured-delan-64x64-f32-d-2": (64, "f32", 2),
    "structured-delan-8x8-f64-d-7": (8, "f64", 7),
}
"""Width of two layers, precision and number of joints of structured DeLaNs; the last has a rival."""
LARGEST = "structured-delan-64x64-f64-d-7"
"""An arm that is only exported and compiled."""
FUNCTIONS = INVERSE, FORWARD, JACOBIAN = ("inverse_dynamics", "forward_dynamics", "inverse_dynamics_jacobian")
STEP = "step_rk4_jacobian"
KINDS = ("additions", "multiplications", "divisions", "functions")
"""Operations that are counted."""
WRAPPER = """#include "casadi.c"

void model_step_rk4_jacobian(const double *x, const double *u, double dt, double *x_next, double *A, double *B)
{
    const double *arguments[] = {x, u, &dt};
    double *results[] = {x_next, A, B}, w[%d];
    long long int iw[%d];
    step(arguments, results, iw, w, 0);
}
"""
HEADER = "void model_step_rk4_jacobian(const double *, const double *, double, double *, double *, double *);\n"


class Times(NamedTuple):
    """Nanoseconds of calls of one function in one process; several processes add a leading axis."""

    hot: np.ndarray
    """Mean times of a call in a loop, one per repeat."""
    cold: np.ndarray
    """Times of single calls, without the clock's own time."""
    sum: Any
    """Sum of the magnitudes of all results, for comparing exports of one model; NaN if not finite."""


def random_network(d: int, width: int, precision: str):
    """Energies of a structured DeLaN of a chain with two layers and fixed random parameters."""
    model = build(describe("structured-delan", precision=precision, needs=chain(d).needs, width=width, depth=2))
    random, dtype = np.random.default_rng(0), data_type(precision)
    shapes = jax.eval_shape(model.init, jax.random.key(0))
    drawn = jax.tree.map(lambda leaf: random.normal(size=leaf.shape) / np.sqrt(leaf.shape[0]), shapes)
    return model.energies(jax.tree.map(lambda leaf: leaf.astype(dtype), drawn))


def compiled(export: Path, place: Path) -> Path:
    """Compiles an export's source to an object file as `load_c` does."""
    built = place / "model.o"
    compile_c([*STANDARD, *FLAGS, f"-I{export}", "-c", str(export / "model.c"), "-o", str(built)])
    return built


def program(function: str, signature: Signature, precision: str) -> str:
    """C source of a program that times one function; it takes REPEATS CALLS COLD BYTES and prints JSON, in ns."""
    arguments, sizes = [], {"inputs": 0, "results": 0}
    for leaf in signature.arguments:
        arguments.append(f"&x[{sizes['inputs']}]" if leaf.shape else f"x[{sizes['inputs']}]")
        sizes["inputs"] += math.prod(leaf.shape)
    for leaf in signature.results:
        arguments += [] if signature.returns else [f"&y[{sizes['results']}]"]
        sizes["results"] += math.prod(leaf.shape)
    call = f"{'y[0] = ' * signature.returns}model_{function}({', '.join(arguments)})"
    real = {"f64": "double", "f32": "float"}[precision]
    return Template(PROGRAM).substitute(sizes, name="model", real=real, call=call)


def programs(export: Path, model: Path, functions: Iterable[str], stated: Path | None = None) -> dict[str, Path]:
    """Builds timing programs of an export's functions beside the object file `model` of its source.

    The signatures are those of `stated`, another export, if the files have no description.
    """
    precision, signatures, _ = read_interface(stated or export, "model")
    built = {}
    for function in functions:
        source = model.with_name(f"time_{function}.c")
        source.write_text(program(function, signatures[function], precision))
        built[function] = source.with_suffix("")
        # Compiled separately from the model, so that no call is inlined into the loop.
        compile_c([*STANDARD, *FLAGS, f"-I{export}", str(source), str(model), "-lm", "-o", str(built[function])])
    return built


def timed(program: Path, *, repeats: int, calls: int, cold: int, mebibytes: int) -> Times:
    """Runs a program: loops of warm calls, calls per loop, single cold calls, memory to read before each of them."""
    command = [program, *map(str, (repeats, calls, cold, mebibytes << 20))]
    answer = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    hot, of_cold = (np.asarray(answer[key], float) for key in ("hot_ns", "cold_ns"))
    return Times(hot, of_cold, math.nan if answer["sum"] is None else answer["sum"])


def evicting() -> int:
    """Memory to read to empty the caches, MiB: twice the last-level cache, if Linux reports it, from 8 to 64."""
    texts = [path.read_text().strip() for path in Path("/sys/devices/system/cpu/cpu0/cache").glob("index*/size")]
    sizes = [int(text[:-1]) for text in texts if text.endswith("K")]
    return min(max(max(sizes, default=2**16) >> 9, 8), 64)


def in_turns(built: dict[str, Path], turns: int, **effort: int) -> dict[str, Times]:
    """Times of programs by turn."""
    rounds = [{key: timed(path, mebibytes=evicting(), **effort) for key, path in built.items()} for _ in range(turns)]
    return {key: Times(*map(np.array, zip(*(one[key] for one in rounds), strict=True))) for key in built}


def ratio(one: np.ndarray, other: np.ndarray) -> float:
    """Ratio of the median times in each turn, median over turns."""
    return float(np.median(np.median(one, axis=1) / np.median(other, axis=1)))


def exported(
    *,
    arms: tuple[str, ...] = tuple(ARMS),
    largest: int = 1,
    turns: int = 5,
    repeats: int = 15,
    calls: int = 2_000,
    cold: int = 200,
    repetitions: int = 200,
) -> Numbers:
    """Times of all functions of all arms, of making them, and with `largest` of making the largest export."""
    from scripts.reports.robots.arm import RIVALS, Timed, pinocchio_functions, rival_arm, seconds_of_calls

    measured: dict[str, dict[str, float]] = {}
    functions, rivals = {}, pinocchio_functions(rival_arm(ARMS[arms[-1]][2]))
    with tempfile.TemporaryDirectory() as place:
        for name in (*arms, *[LARGEST] * largest):
            width, precision, d = ARMS.get(name, (64, "f64", 7))
            began, folder = time.perf_counter(), Path(place) / name
            every = functions_of_system(random_network(d, width, precision), d, dtype=data_type(precision))
            export_c(every, folder, precision=precision, leave_out_large=True)
            written = time.perf_counter()
            model = compiled(folder, folder)
            made = {"export_seconds": written - began, "compiler_seconds": time.perf_counter() - written}
            measured[f"c/{name}"] = {**made, "making_seconds": sum(made.values())}
            if name == LARGEST:
                continue
            times = in_turns(programs(folder, model, FUNCTIONS), turns, repeats=repeats, calls=calls, cold=cold)
            for function, (warm, at_first, _) in times.items():
                quantiles = zip((50, 99, 999), np.percentile(at_first, [50, 99, 99.9]), strict=True)
                measured[f"c/{name}/{function}"] = {
                    "hot_ns": np.median(warm),
                    "hot_spread_ns": np.ptp(np.median(warm, axis=1)),
                    **{f"cold_p{quantile}_ns": value for quantile, value in quantiles},
                }
            measured[f"c/{name}/{JACOBIAN}"]["over_inverse"] = ratio(times[JACOBIAN].hot, times[INVERSE].hot)
            loaded = load_c(folder)
            for function in RIVALS:
                functions[f"c/{name}/{function}"] = Timed(getattr(loaded, function), d, data_type(precision))
    seconds = seconds_of_calls({**functions, **rivals}, repetitions=repetitions)
    for case in functions:
        measured[case]["python_us"] = 1e6 * seconds[case]
    for function, rival in RIVALS.items():
        if rival in rivals:
            case = f"c/{arms[-1]}/{function}"
            measured[case] |= {"pinocchio_us": 1e6 * seconds[rival], f"over_{rival}": seconds[case] / seconds[rival]}
    return measured


def textbook_rates() -> problems.Formula:
    """Rates of the two-link arm by the textbook's formulas, for JAX and for CasADi, with the scene's parameters."""
    scene, rest = two_link_arm(), jnp.zeros(2)
    assert scene.gravity is not None
    (inertia, coupled), (_, elbow) = np.asarray(scene.mass_matrix(rest)).tolist()
    coupling, (both, weight) = coupled - elbow, np.asarray(scene.gravity(rest)).tolist()

    def rates(f, x, u):
        sine, cosine = coupling * f.sin(x[1]), coupling * f.cos(x[1])
        a, b, d = inertia - 2 * coupling + 2 * cosine, elbow + cosine, elbow
        pull = weight * f.cos(x[0] + x[1])
        p = u[0] + sine * (2 * x[2] * x[3] + x[3] ** 2) - ((both - weight) * f.cos(x[0]) + pull)
        q = u[1] - sine * x[2] ** 2 - pull
        determinant = a * d - b * b
        return [x[2], x[3], (d * p - b * q) / determinant, (a * q - b * p) / determinant]

    return rates


def our_steps() -> dict[str, Any]:
    """The Runge-Kutta step with A and B, and examples of its arguments, by origin."""
    scene, rates = two_link_arm(), textbook_rates()
    step = linearised(lambda x, u, dt: rk4(lambda t, x: jnp.stack(rates(jnp, x, u)))(0.0, x, dt))

    def formulas(x, u, dt):
        x_next, (A, B) = step(x, u, dt)
        return {"x_next": x_next, "A": A, "B": B}

    origins = {"energies": scene.energies, "closed-form": scene.closed_form}
    made = {name: functions_of_system(system, 2, dtype=np.float64)[STEP] for name, system in origins.items()}
    return {**made, "formulas": (formulas, (np.zeros(4), np.zeros(2), np.zeros(())))}


def casadi_step(folder: Path, *, shared: bool) -> dict[str, int]:
    """Writes CasADi's C with the interface of ours, and returns its operations by kind.

    `shared` lets CasADi compute common expressions once.
    """
    ca = casadi()
    x, u, dt = ca.SX.sym("x", 4), ca.SX.sym("u", 2), ca.SX.sym("dt")
    x_next = problems.runge_kutta(textbook_rates(), dt)(x, u)
    # Transposed, because CasADi stores columns and C rows.
    results = [x_next, *(ca.densify(ca.jacobian(x_next, variable)).T for variable in (x, u))]
    step = ca.Function("step", [x, u, dt], results, {"cse": shared})
    folder.mkdir()
    generator = ca.CodeGenerator("casadi.c")
    generator.add(step)
    generator.generate(f"{folder}/")
    (folder / "model.h").write_text(HEADER)
    (folder / "model.c").write_text(WRAPPER % (max(step.sz_w(), 1), max(step.sz_iw(), 1)))
    kinds = (ca.OP_ADD, ca.OP_SUB, ca.OP_TWICE), (ca.OP_MUL, ca.OP_SQ), (ca.OP_DIV, ca.OP_INV), (ca.OP_SIN, ca.OP_COS)
    every = [step.instruction_id(k) for k in range(step.n_instructions())]
    return {kind: sum(map(every.count, operations)) for kind, operations in zip(KINDS, kinds, strict=True)}


def beside_casadi(*, turns: int = 9, repeats: int = 15, calls: int = 2_000, cold: int = 200) -> Numbers:
    """Operations and times of all programs; the faster of CasADi's two is the rival."""
    with tempfile.TemporaryDirectory() as place:
        root, kinds, built = Path(place), {}, {}
        for origin, function in our_steps().items():
            for name, finite in ((origin, True), (f"{origin}-any-arguments", False)):
                export_c({STEP: function}, root / name, finite=finite)
                cost = stated_costs(root / name)[STEP]
                kinds[name] = {kind: getattr(cost, kind) for kind in KINDS}
        for name, shared in (("casadi", False), ("casadi-shared", True)):
            kinds[name] = casadi_step(root / name, shared=shared)
        for name in kinds:
            folder = root / name
            stated = root / "closed-form" if name.startswith("casadi") else folder
            built[name] = programs(folder, compiled(folder, folder), [STEP], stated)[STEP]
        times = in_turns(built, turns, repeats=repeats, calls=calls, cold=cold)
    rivals = "casadi", "casadi-shared"
    rival = times[min(rivals, key=lambda name: np.median(times[name].hot))]
    least, measured = min(sum(kinds[name].values()) for name in rivals), {}
    for name, (hot, at_first, total) in times.items():
        operations = sum(kinds[name].values())
        numbers = {"operations": operations, "hot_ns": np.median(hot), "cold_p50_ns": np.median(at_first)}
        if name not in rivals:
            numbers |= {
                "over_casadi": ratio(hot, rival.hot),
                "cold_over_casadi": ratio(at_first, rival.cold),
                "operations_over_casadi": operations / least,
                "relative_difference": abs(total[0] / rival.sum[0] - 1),
            }
        measured[f"casadi/two-link-arm/{name}"] = {**kinds[name], **numbers}
    return measured
