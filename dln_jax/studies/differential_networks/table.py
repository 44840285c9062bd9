"""All that the published table of differential networks has, trained by both optimisers: the work of --table."""

import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from dln_jax.command_line.running import stored_arguments
from dln_jax.data import functions
from dln_jax.data.functions import FunctionSamples, SampleSplit
from dln_jax.files import CONFIG, run_folder, write_json
from dln_jax.learning.regression import WIDTHS, Settings, check, grow_width, train
from dln_jax.metrics.functions import errors, predictions
from dln_jax.nn.activations import activation
from dln_jax.studies.jobs import JOBS, stored_jobs
from dln_jax.studies.report import Row, conditions, write_report

LOSSES = ("type1", "type2")
ACTIVATIONS = ("relu", "softplus", "tanh", "cos")
QUANTITIES = ("value_mse", "gradient_mse", "hessian_mse")
PUBLISHED = {
    "sin": {
        "type1": ((9.8e-6, 6.9e-6, 8.2e-7, 2.0e-7), (4.5e-4, 1.8e-4, 3.1e-5, 2.2e-6), (5.0e-1, 5.9e-3, 1.6e-3, 5.5e-5)),
        "type2": ((5.1e-7, 8.7e-6, 7.6e-6, 1.7e-8), (2.7e-3, 1.5e-4, 4.3e-4, 5.7e-7), (5.0e-1, 4.5e-3, 8.6e-3, 1.2e-5)),
    },
    "cos_sin": {
        "type1": ((4.2e-5, 2.9e-6, 2.6e-6, 2.9e-7), (2.0e-3, 3.7e-5, 1.5e-5, 4.3e-6), (1.0, 1.3e-3, 8.5e-4, 1.7e-4)),
        "type2": ((3.3e-5, 4.3e-5, 8.4e-6, 2.1e-6), (5.0e-3, 8.1e-4, 4.3e-4, 7.0e-5), (1.0, 1.5e-2, 1.2e-2, 1.3e-3)),
    },
}
"""Mean squared errors by function, loss, quantity and activation."""
FACTORS = {"sin": 30.0, "cos_sin": 10.0}
"""By how much the best of our row is to beat the best of the published row."""
TITLES = {
    "sin": ("1-D f", "1-D f'", "1-D f''"),
    "cos_sin": ("2-D f", "2-D gradient", "2-D Hessian"),
}


def write_table(console: Console, given: Any) -> None:
    """Trains, prints and writes report.json; `given` are the arguments of train_diffnet."""
    problems = {
        "sin": (functions.sine(samples=given.samples, seed=given.seed), functions.sine_grid()),
        "cos_sin": (functions.cosine_sine(samples=given.samples, seed=given.seed), functions.cosine_sine_grid()),
    }
    jobs = [
        (function, loss, name, optimizer)
        for optimizer in ("gauss-newton", "adam")
        for function in problems
        for loss in LOSSES
        for name in ACTIVATIONS
        if not (optimizer == "gauss-newton" and name == "relu")
    ]
    for function, loss, name, optimizer in jobs:
        check(problems[function][0], settings(given, function, loss, name, optimizer))
    with run_folder(given.out, "train_diffnet", resume=given.resume) as folder:
        measure_into(folder, given, problems, jobs, console)


def measure_into(folder: Path, given: Any, problems: dict[str, Any], jobs: list[Any], console: Console) -> None:
    """Measures what has not been measured yet, and writes and prints the table."""
    known = {"/".join(job): (*QUANTITIES, "width", "job_seconds") for job in jobs}
    resumed = stored_jobs(folder, known) if given.resume else {}
    found = {tuple(case.split("/")): numbers for case, numbers in resumed.items()}
    write_json(folder / CONFIG, stored_arguments(given))
    for number, job in enumerate(jobs, start=1):
        data, test = problems[job[0]]
        if job not in found:
            found[job] = measure(functions.split(data, seed=given.seed), test, settings(given, *job))
            write_json(folder / JOBS, {"/".join(done): numbers for done, numbers in found.items()})
        mse = "  ".join(f"{found[job][quantity]:.1e}" for quantity in QUANTITIES)
        line = f"{mse}  width {found[job]['width']:.0f}  {found[job]['job_seconds']:.0f} s"
        console.print(f"{number}/{len(jobs)}  {'/'.join(job):36s} {line}")
    seconds = sum(numbers["job_seconds"] for numbers in found.values())
    rows = [*job_rows(found), *best_rows(found)]
    rows.append(Row("table/all", "table_seconds", seconds, "s", bound=900.0))
    facts = conditions(
        dtype="float64 for gauss-newton, float32 for adam",
        seeds=[given.seed],
        adam=f"{given.epochs} epochs (published: 500), 128 units per layer, batch 512",
        gauss_newton=f"{given.coarse_steps} iterations on 2,048 samples and {given.steps} on all, at most; width "
        f"grown through {', '.join(map(str, WIDTHS))} by validation",
        selection="widths and stopping by validation alone; best of a row over losses and activations, as published",
        samples=f"{given.samples} (published: 25,600), noise sd 1e-3 on x, f and gradient, a tenth for validation",
    )
    write_report(folder / "report.json", rows, facts)
    # Numbers that are cut off say nothing: a pipe, or a narrow terminal, gets long lines.
    console = Console(highlight=False, soft_wrap=True, width=max(console.width, 132))
    for optimizer in ("gauss-newton", "adam"):
        console.print(comparison(found, optimizer, facts[optimizer.replace("-", "_")]))
    console.print(best_table(rows))
    console.print("ReLU: the Hessian of a ReLU network is zero almost everywhere, its error that of predicting zero.")
    console.print(f"{facts['machine']}; {facts['threads']} threads; {seconds:.0f} s in all; {facts['samples']}")
    console.print(f"report: {folder / 'report.json'}")


def settings(given: Any, function: str, loss: str, name: str, optimizer: str) -> Settings:
    """The published recipe, or Gauss-Newton on a small network of as many layers."""
    depth = 1 if function == "sin" else 2
    common = Settings(loss=loss, activation=name, depth=depth, seed=given.seed, epochs=given.epochs)
    if optimizer == "adam":
        return common
    budget = {"steps": given.steps, "coarse_steps": given.coarse_steps}
    return common._replace(optimizer=optimizer, width=WIDTHS[0], precision="f64", **budget)


def measure(sets: SampleSplit, test: FunctionSamples, settings: Settings) -> dict[str, float]:
    """Trains one network, at the width that validation chooses or the published one, and measures it on the grid."""
    began = time.perf_counter()
    if settings.optimizer == "gauss-newton":
        chosen, trials = grow_width(sets, settings, lambda candidate: train(sets, candidate))
        settings, training, trained = chosen.candidate, chosen.outcome, [trial.outcome for trial in trials]
    else:
        training = train(sets, settings)
        trained = [training]
    predicted = predictions(training.parameters, test.x, activation=activation(settings.activation))
    return {
        **errors(predicted.mean, test),
        "width": settings.width,
        "train_seconds": sum(each.train_seconds for each in trained),
        "compile_seconds": sum(each.compile_seconds for each in trained),
        "job_seconds": time.perf_counter() - began,
    }


def published(job: tuple[str, ...], quantity: str) -> float:
    """One number of the published table; a job starts with function, loss and activation."""
    function, loss, name = job[:3]
    return PUBLISHED[function][loss][QUANTITIES.index(quantity)][ACTIVATIONS.index(name)]


def job_rows(found: dict[tuple[str, ...], dict[str, float]]) -> list[Row]:
    """A row for every measured number."""
    return [
        Row(
            "/".join(job),
            quantity,
            value,
            "s" if quantity.endswith("_seconds") else "1",
            published(job, quantity) if quantity in QUANTITIES else None,
        )
        for job, numbers in found.items()
        for quantity, value in numbers.items()
    ]


def best_rows(found: dict[tuple[str, ...], dict[str, float]]) -> list[Row]:
    """For each row of the published table, the best of ours, its best, and the bound that follows."""
    rows = []
    for function, factor in FACTORS.items():
        for quantity in QUANTITIES:
            ours = min(numbers[quantity] for job, numbers in found.items() if job[0] == function)
            theirs = min(published((function, loss, name), quantity) for loss in LOSSES for name in ACTIVATIONS)
            rows.append(Row(f"{function}/best", quantity, ours, "1", theirs, theirs / factor))
    return rows


def comparison(found: dict[tuple[str, ...], dict[str, float]], optimizer: str, recipe: str) -> Table:
    """The published table with ours above each published number."""
    columns = [f"{loss} {name}" for loss in LOSSES for name in ACTIVATIONS]
    table = Table("", "", *columns, title=f"{optimizer}: {recipe}", caption="mean squared errors on the clean grid")
    for function, titles in TITLES.items():
        for title, quantity in zip(titles, QUANTITIES, strict=True):
            jobs = [(function, loss, name, optimizer) for loss in LOSSES for name in ACTIVATIONS]
            ours = [f"{found[job][quantity]:.1e}" if job in found else "" for job in jobs]
            theirs = [f"{published(job, quantity):.1e}" for job in jobs]
            table.add_row(title, "ours", *ours)
            table.add_row("", "published", *theirs, style="dim", end_section=True)
    return table


def best_table(rows: list[Row]) -> Table:
    """Best of our row against best of the published row."""
    table = Table("best of the row", "ours", "published", "ratio", "to reach", "pass")
    for row in rows:
        if row.case.endswith("/best") and row.reference is not None:
            function = row.case.removesuffix("/best")
            title = TITLES[function][QUANTITIES.index(row.quantity)]
            ratio = f"{row.reference / row.value:,.0f}x"
            passed = "yes" if row.passed else "[bold red]no[/]"
            table.add_row(title, f"{row.value:.1e}", f"{row.reference:.1e}", ratio, f"{FACTORS[function]:.0f}x", passed)
    return table
