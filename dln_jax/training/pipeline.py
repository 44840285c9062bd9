"""The one pipeline of training commands: read and check, fit, store, judge, draw, print.

A kind of training (dynamics, phase spaces, images, functions, identification, value functions) is a `Kind`: functions
that `train` calls in this order. Nothing is written before the data and options have been checked.
"""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

from jax.sharding import Mesh

from dln_jax.models.model import Parameters
from dln_jax.runs.report import Report, finish
from dln_jax.runs.scaled import mesh_of
from dln_jax.runs.stored_arguments import command_folder
from dln_jax.zoo.descriptions import Description
from dln_jax.zoo.run import save


class Fitted(NamedTuple):
    """A fitted model, and the record that the kind's own `judge` needs."""

    description: Description
    """Description of the model, final choices included."""
    parameters: Parameters
    outcome: Any
    """Record of the fit, such as its task and training history."""


class Kind(NamedTuple):
    """A kind of training."""

    read: Callable[[Any], Any]
    """options -> case: the data and everything that the options name; refuses with an `InputError`."""
    announce: Callable[[Any], Iterable[str]]
    """case -> lines on the data, the model and what is assumed."""
    fit: Callable[[Any, Any, Path, Mesh | None], Fitted]
    """(case, options, run folder, devices) -> the fit; may store checkpoints."""
    judge: Callable[[Any, Fitted, Any, Path], Report]
    """(case, fit, options, run folder) -> errors, costs and verdict of the stored model."""
    save: Callable[[Path, Fitted, Any], None] = lambda folder, fitted, _: save(
        folder, fitted.description, fitted.parameters
    )
    """(run folder, fit, case) -> nothing; stores the model."""


def train(kind: Kind, options: Any, command: str) -> None:
    """Trains, evaluates and writes a run folder, by default runs/`command`-1, -2, ...

    Raises:
        InputError: a mistake in the options or data, before anything is written; or a training that failed.
        FitRefused: the model must not be used, and no limit of the user ended its training; the run folder is complete.
    """
    mesh = mesh_of(options) if hasattr(options, "devices") else None
    case = kind.read(options)
    with command_folder(options, command) as folder:
        for text in kind.announce(case):
            print(text)
        fitted = kind.fit(case, options, folder, mesh)
        kind.save(folder, fitted, case)
        finish(folder, options, kind.judge(case, fitted, options, folder))
