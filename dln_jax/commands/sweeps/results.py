"""Results of a sweep: metrics of all jobs, medians over seeds, the best job by validation alone, and a figure."""

import csv
import io
import statistics
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from dln_jax.commands.sweeps.jobs import METRICS, Job, status_of
from dln_jax.figures import style
from dln_jax.files import as_type, finite, is_file, read_json, write_bytes, write_json
from dln_jax.runs.report import print_numbers, spaced
from dln_jax.types import InputError

COMPARED = {
    "validation": ("validation_error", "validation_loss", "validation"),
    "error": ("torque_mse", "value_mse", "rollout_mse", "torque_nmse", "down_return_mean"),
    "train_seconds": ("train_seconds", "learning_seconds", "identify_seconds"),
}
"""Metrics to compare by default: the first of each kind that the jobs have."""
PROBLEM = [
    "creature",
    "data",
    "function",
    "goal",
    "lock",
    "needs",
    "objective",
    "plant",
    "robot",
    "scene",
    "task",
    "test",
]
"""Options that define a problem; errors of different problems are not compared."""
WIDTH = 200
"""Width of tables in columns. A narrow terminal wraps their lines, since truncated numbers would be useless."""
MOST_ROWS = 200
MOST_PANELS = 6
"""Largest number of problems drawn in panels of their own."""
MOST_COLOURS = 8
"""Largest number of colours in the legend."""
MOST_NAMED = 12
"""Largest number of medians that are named in the figure rather than by a legend."""
RUN: dict[str, Any] = {"markersize": 4, "markeredgewidth": 0, "alpha": 0.45, "zorder": 2}
MEDIAN: dict[str, Any] = {"markersize": 8, "markeredgewidth": 0, "zorder": 3}
BEST: dict[str, Any] = {"markersize": 13, "fillstyle": "none", "zorder": 4}


def compare(
    jobs: Sequence[Job],
    over: Sequence[str] = (),
    *,
    metric: str | None = None,
    error: str | None = None,
    largest: bool = False,
) -> dict[str, Any]:
    """Compares all jobs; returns the contents of sweep.json.

    `jobs` has a row for each job: its values, status and metrics, and whether it is the best of several jobs with the
    same problem. `groups` has medians and the worst of jobs that differ only in the options `over`. A number is `None`
    if the job lacks it or it is not finite.

    Args:
        over: options that medians are taken over.
        metric: metric that chooses the best job; default: a validation error.
        error: metric that is shown beside it; default: a test error.

    Raises:
        InputError: jobs have metrics, but none has the requested one.
    """
    rows = []
    for job in jobs:
        status, metrics = status_of(job.folder), {}
        path, remedy = job.folder / status.run / METRICS, "remove the job's folder, and --resume"
        if status.state == "done" and is_file(path):
            try:
                metrics = read_json(path, remedy=remedy)
                metrics = finite(as_type(metrics, dict[str, float | None], name=str(path), remedy=remedy))
            except InputError as mistake:
                status, metrics = status._replace(state="failed", line=str(mistake)), {}
        row = {"job": job.folder.name, "values": dict(job.values), "best": False}
        rows.append(row | status._asdict() | {"metrics": metrics})
    known = list(dict.fromkeys(name for row in rows for name in row["metrics"]))
    for option, name in (("metric", metric), ("error", error)):
        if known and name not in (None, *known):
            raise InputError(
                f"--{option}: no job has the metric {name!r:.40}; choose from {', '.join(sorted(known))}. Jobs that "
                f"are done are kept: --resume with another --{option} only makes the table"
            )
    stated = {"validation": metric, "error": error}
    names = {
        kind: stated.get(kind) or next((name for name in usual if name in known), None)
        for kind, usual in COMPARED.items()
    }
    judge = names["validation"]
    chosen = [row for row in rows if row["metrics"].get(judge) is not None]
    for rivals in classes(chosen, lambda row: problem_of(row["values"])).values():
        if len(rivals) > 1:
            (max if largest else min)(rivals, key=lambda row: row["metrics"][judge])["best"] = True
    groups = []
    others = classes(rows, lambda row: [(name, text) for name, text in row["values"].items() if name not in over])
    for values, part in others.items():
        medians, worst = {}, {}
        for name in filter(None, names.values()):
            numbers = [number for row in part if (number := row["metrics"].get(name)) is not None]
            medians[name] = statistics.median(numbers) if numbers else None
            worst[name] = (min if largest and name == judge else max)(numbers, default=None)
        done = sum(row["state"] == "done" for row in part)
        groups.append({"values": dict(values), "done": done, "jobs": len(part), "medians": medians, "worst": worst})
    return {"names": names, "over": list(over), "metrics": known, "jobs": rows, "groups": groups}


def classes(rows: Iterable[dict[str, Any]], key: Callable[[dict[str, Any]], Any]) -> dict[Any, list[dict[str, Any]]]:
    """Groups rows by their key, in order."""
    groups: dict[Any, list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault(tuple(key(row)), []).append(row)
    return groups


def problem_of(values: Mapping[str, str]) -> tuple[tuple[str, str], ...]:
    """Returns the options of a job that define its problem, with their values."""
    return tuple((name, text) for name, text in values.items() if name in PROBLEM)


def print_results(results: Mapping[str, Any], command: str, folder: Path) -> None:
    """Prints all jobs, their medians, the unfinished jobs, the sweep's folder, and the best jobs.

    A long sweep shows only the best and the unfinished jobs.
    """
    rows, over, names = results["jobs"], results["over"], results["names"]
    best, missed = [row for row in rows if row["best"]], [row for row in rows if row["state"] != "done"]
    listed, title = rows, f"{command}, {len(rows)} jobs"
    if len(rows) > MOST_ROWS:
        listed = [row for row in rows if row["best"] or row["state"] != "done"][:MOST_ROWS]
        title = f"{title} (the best and the unfinished; table.csv has all)"
    table = []
    for row in listed:
        numbers = {name: row["metrics"].get(name) for name in filter(None, names.values())}
        again = f", attempt {row['attempt']}" if row["attempt"] > 1 else ""
        status = ("best" if row["best"] else row["state"]) + again
        table.append({"job": row["job"], **row["values"], **numbers, "status": status})
    print_rows(title, table)
    if over:
        table = []
        for group in results["groups"]:
            worst = {
                f"worst {name}": number for name, number in group["worst"].items() if name != names["train_seconds"]
            }
            done = f"{group['done']} of {group['jobs']}"
            table.append({**group["values"], "done": done, **group["medians"], **worst})
        print_rows(f"medians over {', '.join(over)}, and the worst", table)
    if results["metrics"] and names["validation"] is None:
        known = ", ".join(sorted(results["metrics"]))
        print(f"no job has a validation error, so none is the best; choose a --metric from {known}")
    if missed:
        print(unfinished(rows))
        for (state, line), part in classes(missed, lambda row: (row["state"], row["line"])).items():
            print(f"  {', '.join(row['job'] for row in part)} {state}: {line}")
        print(f"--out {folder} --resume runs them again")
    print(f"sweep: {folder}")
    if best and names["error"] in COMPARED["error"]:
        print(f"{names['error']} is measured on the test set and did not influence the choice")
    for row in best:
        values = " ".join(f"{name}={text}" for name, text in row["values"].items())
        print(f"best by {names['validation']}: {values}, run folder {folder / 'jobs' / row['job'] / row['run']}")


def print_rows(title: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """Prints rows with the same keys as a table; paths are shortened to their last part."""
    cells = [
        [f"{cell:.3g}" if isinstance(cell, float | int) else shortened(cell or "") for cell in row.values()]
        for row in rows
    ]
    print_numbers(cells, title=title, columns=[spaced(name) for name in (rows[0] if rows else ())], width=WIDTH)


def write_tables(folder: Path, results: Mapping[str, Any]) -> None:
    """Writes sweep.json, and table.csv with all metrics of every job."""
    text, rows, metrics = io.StringIO(), results["jobs"], results["metrics"]
    table = csv.writer(text)
    table.writerow(map(_cell, ("job", *rows[0]["values"], "status", "line", "best", "attempts", *metrics)))
    for row in rows:
        texts = map(_cell, (*row["values"].values(), row["state"], row["line"]))
        table.writerow([row["job"], *texts, int(row["best"]), row["attempt"], *map(row["metrics"].get, metrics)])
    write_bytes(folder / "table.csv", text.getvalue().encode())
    write_json(folder / "sweep.json", results)


def _cell(text: str) -> str:
    """Converts text to a cell; text that a spreadsheet would run as a formula is quoted."""
    try:
        float(text)
    except ValueError:
        return f"'{text}" if text.startswith(("=", "+", "-", "@", "\t", "\r")) else text
    return text


def unfinished(rows: Sequence[Mapping[str, Any]]) -> str:
    """Counts unfinished jobs by state; empty if all are done."""
    states = Counter(row["state"] for row in rows if row["state"] != "done")
    counts = ", ".join(f"{count} {state}" for state, count in states.items())
    return f"{len(rows)} jobs: {counts}" if states else ""


def shortened(text: str) -> str:
    """A value for a table; a path is shortened to its last part."""
    return Path(text).name


def sweep_figure(results: Mapping[str, Any], at_once: int | None) -> Figure | None:
    """Draws error against training time, `at_once` jobs at once; `None` if no job has both.

    Each problem has a panel, unless there are many. The first two options that no medians are taken over are shown by
    colours and markers, and named at the medians, or in a legend if there are many. Runs beside medians are faint.
    """
    rows, over, names = results["jobs"], results["over"], results["names"]
    shown = [(row["values"], row["metrics"], RUN if over else MEDIAN) for row in rows]
    shown += [(row["values"], row["metrics"], BEST) for row in rows if row["best"]]
    shown += [(group["values"], group["medians"], MEDIAN) for group in results["groups"] if over]
    seconds, error = names["train_seconds"], names["error"]
    points = [(values, numbers.get(seconds), numbers.get(error), size) for values, numbers, size in shown]
    points = [point for point in points if None not in point[1:3]]
    if not points:
        return None
    problems = list(dict.fromkeys(problem_of(row["values"]) for row in rows))
    panels = len(problems) <= MOST_PANELS and len(problems) < len(rows)
    options = [name for name in rows[0]["values"] if name not in (*over, *(PROBLEM if panels else ()))]
    colour, marker = (*options, "", "")[:2]

    def look(values: Mapping[str, str], name: str) -> str:
        return shortened(values.get(name, ""))

    kinds, forms = (list(dict.fromkeys(look(point[0], name) for point in points)) for name in (colour, marker))
    colours = dict(zip(kinds, colormaps["viridis"](np.linspace(0, 0.85, len(kinds))), strict=True))
    markers = {form: style.MARKERS[number % len(style.MARKERS)] for number, form in enumerate(forms)}

    named = len(results["groups"]) <= MOST_NAMED
    beside = f" (jobs at once: {at_once})" if at_once else ""
    work = seconds.removesuffix("_seconds").replace("train", "training")

    problems = problems if panels else [()]
    columns = min(len(problems), 2)
    lines = -(-len(problems) // columns)
    figure, axes = style.figure(lines, columns, height=2.7 * lines + 1.3)
    for axis in axes.flat[len(problems) :]:
        axis.axis("off")
    for axis, problem in zip(axes.flat, problems, strict=False):
        here = [point for point in points if not panels or problem_of(point[0]) == problem]
        for values, x, y, size in here:
            if size is BEST:
                axis.plot(x, y, "o", color="black", **size)
                continue
            kind, form = look(values, colour), look(values, marker)
            axis.plot(x, y, markers[form], color=colours[kind], **size)
            if size is MEDIAN and named:
                text = f"{spaced(colour)} {kind} {spaced(marker)} {form}".removeprefix("model ")
                axis.annotate(text, (x, y), (7, 0), textcoords="offset points", va="center", fontsize=style.SMALL)
        axis.set_xscale(style.scale_of(x for _, x, _, _ in here))
        axis.set_yscale(style.scale_of(y for _, _, y, _ in here))
        style.title(axis, ", ".join(f"{name} {shortened(text)}" for name, text in problem))
        axis.set_xlabel(f"{work}, s{beside}")
        axis.set_ylabel("test " * (error in COMPARED["error"]) + spaced(error))

    def handle(marker: str, label: str, **looks: Any) -> Line2D:
        return Line2D([], [], marker=marker, label=label, **{"linestyle": "", "color": "0.4", **looks})

    handles = []
    if not named:
        few = kinds[:: -(-len(kinds) // MOST_COLOURS)]
        handles += [handle("s", f"{spaced(colour)} {kind}", color=colours[kind]) for kind in few]
        handles += [handle(markers[form], f"{spaced(marker)} {form}") for form in forms if form]
    if over:
        handles += [handle("o", "a run", **RUN), handle("o", "median", **MEDIAN)]
    if any(row["best"] for row in rows):
        handles.append(handle("o", "best in validation", **{**BEST, "color": "black"}))
    note = {"title": unfinished(rows) or None, "title_fontsize": style.SMALL}
    style.legend(figure, handles=handles, loc="outside lower center", ncols=4, **note)
    return figure
