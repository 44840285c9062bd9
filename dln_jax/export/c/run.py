"""A trained run as C99 source: every function that its model has, or those that are asked for."""

from collections.abc import Sequence
from pathlib import Path

from dln_jax.export.c.families import DERIVATIVES, functions_of_run
from dln_jax.export.c.source import export_c
from dln_jax.export.c.text import PRECISIONS
from dln_jax.mechanics.discrete import ITERATIONS
from dln_jax.types import InputError
from dln_jax.zoo.run import load


def export_run(
    run: str | Path,
    directory: str | Path,
    *,
    functions: Sequence[str] | None = None,
    name: str = "model",
    precision: str | None = None,
    iterations: int = ITERATIONS,
    libm: bool = False,
    casadi: bool = False,
    overwrite: bool = False,
) -> list[Path]:
    """`export_c` of the model in a run's folder.

    Args:
        run: the folder.
        directory: of the export.
        functions: names of `families.functions_of_run`; all by default, but for those that are too large for C, and
            for CasADi those that are no derivatives.
        name: of the export.
        precision: f32 or f64; by default that of the training.
        iterations: Newton steps of the implicit midpoint rule.
        libm, casadi, overwrite: as for `export_c`.

    Raises:
        InputError: no run, no such function, or what `export_c` refuses.
    """
    trained = load(run)
    precision = precision or str(trained.description["precision"])
    if precision not in PRECISIONS:
        raise InputError(f"precision is {precision!r}; expected f32 or f64")
    chosen = functions_of_run(trained, precision=precision, names=functions, iterations=iterations)
    # CasADi has the first and second derivatives of what it is given.
    itself = casadi if functions else casadi and [function for function in chosen if not function.endswith(DERIVATIVES)]
    return export_c(
        chosen, directory, name=name, precision=precision, libm=libm, casadi=itself, overwrite=overwrite,
        leave_out_large=functions is None,
    )  # fmt: skip
