"""benchmark casadi: a Runge-Kutta step of the two-link arm with A and B, in exported C and in CasADi's C.

Both are compiled by the same compiler with the same flags, in separate processes that take turns in one run; medians
over turns count. CasADi gets the textbook's formulas, its Jacobian and its elimination of common expressions, and the
faster of its two programs is the rival. Ours come from the energies, from the closed form, and from the same formulas.
"""

import tempfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from dln_jax.export.c.families import functions_of_system
from dln_jax.export.c.interface import Cost, stated_costs
from dln_jax.export.c.load import FLAGS, STANDARD, compile_c
from dln_jax.export.c.source import export_c
from dln_jax.mechanics.discrete import linearised
from dln_jax.scenes.pendulums import two_link_arm
from scripts.reports.case import Findings
from scripts.reports.control.plan_problems import Formula, runge_kutta
from scripts.reports.rival_modules import casadi
from scripts.reports.rows import Row, expect
from scripts.reports.speed.calls_in_c import Times, compiled, evicting, programs, timed
from scripts.reports.speed.exported_c import AGREEMENT, QUICK_TURNS, cold_median, hot, ratio

STEP = "step_rk4_jacobian"
CASE = "two-link-arm"
TURNS = 9
_ARGUMENTS = "const double x[4], const double u[2], double dt, double x_next[4], double A[16], double B[8]"
_HEADER = f"void model_{STEP}({_ARGUMENTS});\n"
_WRAPPER = f"""#include "casadi.c"
#include "model.h"

void model_{STEP}({_ARGUMENTS})
{{
    const double *arguments[] = {{x, u, &dt}};
    double *results[] = {{x_next, A, B}}, w[%d];
    long long int iw[%d];
    step(arguments, results, iw, w, 0);
}}
"""


def textbook_rates() -> Formula:
    """Rates of the arm by the textbook's formulas, for JAX and for CasADi; its parameters are those of the scene."""
    scene, rest = two_link_arm(), jnp.zeros(2)
    assert scene.gravity is not None
    (inertia, coupled), (_, elbow) = np.asarray(scene.mass_matrix(rest)).tolist()
    coupling, (both, weight) = coupled - elbow, np.asarray(scene.gravity(rest)).tolist()

    def rates(f: Any, x: Any, u: Any) -> list[Any]:
        sine, cosine = coupling * f.sin(x[1]), coupling * f.cos(x[1])
        a, b, d = inertia - 2 * coupling + 2 * cosine, elbow + cosine, elbow
        pull = weight * f.cos(x[0] + x[1])
        p = u[0] + sine * (2 * x[2] * x[3] + x[3] ** 2) - ((both - weight) * f.cos(x[0]) + pull)
        q = u[1] - sine * x[2] ** 2 - pull
        determinant = a * d - b * b
        return [x[2], x[3], (d * p - b * q) / determinant, (a * q - b * p) / determinant]

    return rates


def ours() -> dict[str, Any]:
    """The step with A and B, and examples of its arguments, by origin."""
    scene, examples = two_link_arm(), (np.zeros(4), np.zeros(2), np.zeros(()))
    rates = textbook_rates()
    step = linearised(lambda x, u, dt: jnp.stack(runge_kutta(rates, dt)(jnp, list(x), list(u))))

    def formulas(x: Any, u: Any, dt: Any) -> dict[str, Any]:
        x_next, (A, B) = step(x, u, dt)
        return {"x_next": x_next, "A": A, "B": B}

    origins = {"energies": scene.energies, "closed-form": scene.closed_form}
    made = {name: functions_of_system(system, 2, dtype=np.float64)[STEP] for name, system in origins.items()}
    return {**made, "formulas": (formulas, examples)}


def casadi_step(folder: Path, *, shared: bool) -> tuple[Path, Counter[str]]:
    """Writes and compiles CasADi's C with the interface of ours; returns its object file and its operations by kind.

    Args:
        folder: folder of the files.
        shared: let CasADi compute common expressions once.
    """
    ca = casadi()
    x, u, dt = ca.SX.sym("x", 4), ca.SX.sym("u", 2), ca.SX.sym("dt")
    x_next = ca.vertcat(*runge_kutta(textbook_rates(), dt)(ca, x, u))
    # Transposed, because CasADi stores columns and C rows.
    results = [x_next, *(ca.densify(ca.jacobian(x_next, variable)).T for variable in (x, u))]
    step = ca.Function("step", [x, u, dt], results, {"cse": shared})
    folder.mkdir(parents=True)
    generator = ca.CodeGenerator("casadi.c")
    generator.add(step)
    generator.generate(f"{folder}/")
    (folder / "model.h").write_text(_HEADER)
    (folder / "model.c").write_text(_WRAPPER % (max(step.sz_w(), 1), max(step.sz_iw(), 1)))
    compile_c([*STANDARD, *FLAGS, f"-I{folder}", "-c", str(folder / "model.c"), "-o", str(folder / "model.o")])
    kinds = {
        "additions": (ca.OP_ADD, ca.OP_SUB, ca.OP_TWICE), "multiplications": (ca.OP_MUL, ca.OP_SQ),
        "divisions": (ca.OP_DIV, ca.OP_INV), "functions": (ca.OP_SIN, ca.OP_COS),
    }  # fmt: skip
    every = Counter(step.instruction_id(k) for k in range(step.n_instructions()))
    return folder / "model.o", Counter({kind: sum(every[op] for op in ops) for kind, ops in kinds.items()})


def measure(quick: bool) -> Findings:
    """Operations and times of all programs, and their ratios."""
    effort = {"repeats": 3, "calls": 500, "cold": 50} if quick else {"repeats": 15, "calls": 2_000, "cold": 200}
    with tempfile.TemporaryDirectory() as place:
        built, kinds = {}, {}
        for name, function in ours().items():
            for case, finite in ((name, True), (f"{name}-any-arguments", False)):
                folder = Path(place) / case
                export_c({STEP: function}, folder, finite=finite)
                built[case] = programs(folder, compiled(folder, folder), [STEP])[STEP]
                kinds[case] = _kinds(stated_costs(folder)[STEP])
        for case, shared in (("casadi", False), ("casadi-shared", True)):
            model, kinds[case] = casadi_step(Path(place) / case, shared=shared)
            built[case] = programs(model.parent, model, [STEP])[STEP]
        turns = [
            {case: timed(path, mebibytes=evicting(), **effort) for case, path in built.items()}
            for _ in range(QUICK_TURNS if quick else TURNS)
        ]
    return Findings(rows_of({case: [turn[case] for turn in turns] for case in built}, kinds))


def _kinds(cost: Cost) -> Counter[str]:
    return Counter({kind: getattr(cost, kind) for kind in ("additions", "multiplications", "divisions", "functions")})


def rows_of(times: Mapping[str, Sequence[Times]], kinds: Mapping[str, Counter[str]]) -> list[Row]:
    """Rows of the programs by name; those of CasADi begin with its name, and the faster of them is the rival."""

    def median(number: Callable[[Times], float], case: str) -> float:
        return float(np.median([number(turn) for turn in times[case]]))

    rivals = [case for case in times if case.startswith("casadi")]
    rival, least = min(rivals, key=lambda case: median(hot, case)), min(kinds[case].total() for case in rivals)
    rows = [Row(CASE, "compiler", 0.0, "1", expected=f"{times[rival][0].compiler} {' '.join((*STANDARD, *FLAGS))}")]
    for case, turns in times.items():
        rows += [Row(f"{CASE}/{case}", kind, float(count), "1") for kind, count in kinds[case].items()]
        rows.append(Row(f"{CASE}/{case}", "operations", float(kinds[case].total()), "1", expected="a function is one"))
        rows += [Row(f"{CASE}/{case}", f"{name}_ns", median(number, case), "ns")
                 for name, number in (("hot", hot), ("cold_p50", cold_median))]  # fmt: skip
        if case in rivals:
            continue
        words = f"in a warm loop, the time of {rival}"
        rows.append(expect(f"{CASE}/{case}", "over_casadi", words, ratio(turns, times[rival], hot), 1.0))
        rows.append(Row(f"{CASE}/{case}", "cold_over_casadi", ratio(turns, times[rival], cold_median), "1"))
        rows.append(Row(f"{CASE}/{case}", "operations_over_casadi", kinds[case].total() / least, "1"))
        difference = abs(turns[0].sum / times[rival][0].sum - 1)
        rows.append(Row(f"{CASE}/{case}", "relative_difference", difference, "1", bound=AGREEMENT["f64"]))
    return rows
