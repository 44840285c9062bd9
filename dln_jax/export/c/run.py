"""Exports a trained run as C99 source: all functions of its model, or a selection."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dln_jax.export.c.families import DERIVATIVES, functions_of_run
from dln_jax.export.c.source import export_c
from dln_jax.export.c.text import PRECISIONS
from dln_jax.mechanics.discrete import ITERATIONS
from dln_jax.types import InputError
from dln_jax.zoo.descriptions import build
from dln_jax.zoo.run import load


def export_run(
    run: str | Path,
    directory: str | Path,
    *,
    functions: Sequence[str] | None = None,
    name: str = "model",
    precision: str | None = None,
    iterations: int = ITERATIONS,
    temperature: float | None = None,
    casadi: bool = False,
    finite: bool = False,
    overwrite: bool = False,
) -> list[Path]:
    """Exports the model of a run with `export_c`, and returns the paths of the files.

    Args:
        run: folder of the run.
        directory: folder of the export.
        functions: names from `families.functions_of_run`; default: all of suitable size, for CasADi no derivatives.
        precision: f32 or f64; default: the precision of the training.
        iterations: Newton steps of the implicit midpoint rule.
        temperature: temperature of the C functions in °C, for a robot whose friction depends on it; default: the
            reference temperature of its identification.
        casadi, finite, overwrite: as for `export_c`.

    Raises:
        InputError: no run in the folder, an unknown or refused function, or a model independent of temperature.
    """
    trained = load(run)
    if temperature is not None:
        if not np.any(trained.description.get("cooling", 0.0)):
            raise InputError(f"the model in {run} does not depend on temperature; leave --temperature out")
        trained = dataclasses.replace(trained, model=build({**trained.description, "temperature": float(temperature)}))
    precision = precision or str(trained.description["precision"])
    if precision not in PRECISIONS:
        raise InputError(f"precision is {precision!r}; expected f32 or f64")
    chosen = functions_of_run(trained, precision=precision, names=functions, iterations=iterations)
    # NAME_casadi.c contains first and second derivatives of its functions.
    itself = casadi if functions else casadi and [function for function in chosen if not function.endswith(DERIVATIVES)]
    return export_c(
        chosen, directory, name=name, precision=precision, casadi=itself, overwrite=overwrite,
        finite=finite, leave_out_large=functions is None,
    )  # fmt: skip
