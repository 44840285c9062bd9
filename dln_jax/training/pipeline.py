"""The one pipeline of training commands: read and check, fit, store, judge, draw, print.

A kind of training (dynamics, phase spaces, images, functions, identification, value functions) is a `Kind`: functions
that `train` calls in this order. Nothing is written before the data and options have been checked.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jax.sharding import Mesh
from matplotlib.figure import Figure

from dln_jax.errors import FitRefused, InputError
from dln_jax.files import write_figure, write_json
from dln_jax.metrics.verdict import Verdict
from dln_jax.models.model import Parameters
from dln_jax.runs.scaled import mesh_of
from dln_jax.runs.stored_arguments import command_folder, write_config
from dln_jax.training.results import print_numbers
from dln_jax.zoo.descriptions import Description
from dln_jax.zoo.run import save


class Fitted(NamedTuple):
    """A fitted model, and the record that the kind's own `judge` needs."""

    description: Description
    """Description of the model, final choices included."""
    parameters: Parameters
    outcome: Any
    """Record of the fit, such as its task and training history."""


class Judged(NamedTuple):
    """Evaluation of a fitted model."""

    metrics: dict[str, float | int]
    """Contents of metrics.json, apart from those that are still being measured."""
    rows: Callable[[dict[str, float | int]], Iterable[Sequence[str]]]
    """All metrics -> rows of the printed table."""
    title: str
    columns: tuple[str, ...] = ("quantity", "value", "unit")
    measured: Callable[[], dict[str, float]] = dict
    """Waits for metrics that another process measures while the figures are drawn."""
    verdict: Verdict | None = None
    """Whether the model may be used; `None` where nothing decides it."""
    figures: Mapping[str, Callable[[Path], None]] = {}
    """Functions that write figures and films to a path, by file name."""
    chosen: Mapping[str, Any] = {}
    """Values for config.json that the fit chose from the arguments."""
    lines: tuple[str, ...] = ()
    """Lines below the table."""
    ended_by_user: bool = False
    """Whether the user's own limit of steps or time ended the training: a refused fit is then a warning."""
    error: str = ""
    """Why the command fails although its run folder is complete; empty if it does not."""


def png(draw: Callable[..., Figure], *arguments: Any, **options: Any) -> Callable[[Path], None]:
    """Function that draws a figure and writes it to a path."""
    return lambda path: write_figure(path, draw(*arguments, **options))


class Kind(NamedTuple):
    """A kind of training."""

    read: Callable[[Any], Any]
    """options -> case: the data and everything that the options name; refuses with an `InputError`."""
    announce: Callable[[Any], Iterable[str]]
    """case -> lines on the data, the model and what is assumed."""
    fit: Callable[[Any, Any, Path, Mesh | None], Fitted]
    """(case, options, run folder, devices) -> the fit; may store checkpoints."""
    judge: Callable[[Any, Fitted, Any, Path], Judged]
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
        judged = kind.judge(case, fitted, options, folder)
        if getattr(options, "figures", False):
            for name, draw in judged.figures.items():
                draw(folder / name)
        metrics = {**judged.metrics, **judged.measured()}
        write_json(folder / "metrics.json", metrics)
        verdict = {} if judged.verdict is None else {"verdict": judged.verdict._asdict()}
        write_config(folder, options, **judged.chosen, **verdict)
        print_numbers(judged.rows(metrics), title=judged.title, columns=judged.columns)
        for text in judged.lines:
            print(text)
        print(f"run folder: {folder}")
        conclude(judged)


def conclude(judged: Judged) -> None:
    """Prints the verdict, and raises an error for a training that failed or a model that must not be used."""
    if judged.verdict is not None:
        print(judged.verdict.line)
    if judged.error:
        raise InputError(judged.error)
    if judged.verdict is not None and judged.verdict.level == "refused":
        if not judged.ended_by_user:
            raise FitRefused(judged.verdict)
        print(
            "warning: refused, but training ended at your own limit (--steps, --iterations or --seconds), so the exit "
            "status is 0; train longer before you use this model"
        )
