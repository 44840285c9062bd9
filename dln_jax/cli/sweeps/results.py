"""Results of a sweep: metrics of all jobs, medians over seeds, and the best job, chosen by validation alone."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dln_jax.cli.sweeps.job import METRICS, Job, Status, status_of
from dln_jax.files import is_file, read_json
from dln_jax.types import InputError

VALIDATION = ("validation_error", "validation_loss", "validation")
ERRORS = ("torque_mse", "value_mse", "rollout_mse", "torque_nmse", "down_return_mean")
SECONDS = ("train_seconds", "learning_seconds", "identify_seconds")
"""Names of metrics in the commands; of every group the first name that the jobs have counts."""
PROBLEM = (
    "creature", "data", "function", "goal", "hold", "needs", "objective", "plant", "robot", "scene", "task", "test",
)  # fmt: skip
"""Options that define a problem; errors of different problems are not compared."""


class Names(NamedTuple):
    """Names of the metrics in use; `None` if no job has such a metric."""

    validation: str | None
    error: str | None
    seconds: str | None
    largest: bool = False
    """Whether the best validation is the largest."""


class Entry(NamedTuple):
    """A job, its status and its metrics."""

    job: Job
    status: Status
    metrics: dict[str, Any]

    def number(self, name: str | None) -> float | None:
        """A metric; `None` if the job lacks it or it is not finite."""
        value = self.metrics.get(name) if name else None
        return float(value) if isinstance(value, int | float) and math.isfinite(value) else None


class Group(NamedTuple):
    """Jobs that differ only in the options that medians are taken over."""

    values: dict[str, str]
    done: int
    jobs: int
    medians: dict[str, float]
    worst: dict[str, float]


def entries(jobs: Sequence[Job]) -> list[Entry]:
    """All jobs with their status, and metrics if they are done; a job with damaged metrics counts as failed."""
    found = []
    for job in jobs:
        status, metrics = status_of(job.folder), {}
        path = job.folder / status.run / METRICS
        if status.state == "done" and is_file(path):
            try:
                metrics = read_json(path, remedy="remove the job's folder, and --resume")
            except InputError as error:
                status = status._replace(state="failed", line=str(error))
        found.append(Entry(job, status, metrics))
    return found


def names_in(found: Sequence[Entry], validation: str | None, error: str | None, *, largest: bool) -> Names:
    """The requested metrics, else the first usual names that any job has."""
    known = list(dict.fromkeys(name for entry in found for name in entry.metrics))

    def first(usual: Sequence[str]) -> str | None:
        return next((name for name in usual if name in known), None)

    return Names(validation or first(VALIDATION), error or first(ERRORS), first(SECONDS), largest)


def require_known(found: Sequence[Entry], **asked: str | None) -> None:
    """Raises `InputError` for a requested metric that no job has, if any job has metrics."""
    known = sorted({name for entry in found for name in entry.metrics})
    for option, name in asked.items():
        if known and name is not None and name not in known:
            raise InputError(
                f"--{option}: no job has the metric {name!r:.40}; choose from {', '.join(known)}. Jobs that are done "
                f"are kept: --resume with another --{option} only makes the table"
            )


def problem_of(values: Mapping[str, str]) -> tuple[str, ...]:
    """The values of a job that define its problem."""
    return tuple(f"{name} {shown(text)}" for name, text in values.items() if name in PROBLEM)


def shown(text: str) -> str:
    """A value for a table; a path is shortened to its last part."""
    return Path(text).name if "/" in text else text


def best_of(found: Sequence[Entry], names: Names) -> list[Entry]:
    """The job with the best validation for every problem with several jobs; test errors are ignored."""
    problems: dict[tuple[str, ...], list[Entry]] = {}
    for entry in found:
        if entry.number(names.validation) is not None:
            problems.setdefault(problem_of(entry.job.values), []).append(entry)
    choose = max if names.largest else min
    several = [each for each in problems.values() if len(each) > 1]
    return [choose(each, key=lambda entry: entry.number(names.validation) or 0.0) for each in several]


def groups(found: Sequence[Entry], over: Sequence[str], names: Names) -> list[Group]:
    """Median and worst of the jobs that differ only in `over`, in the order of the jobs."""
    parts: dict[tuple[tuple[str, str], ...], list[Entry]] = {}
    for entry in found:
        key = tuple((name, text) for name, text in entry.job.values.items() if name not in over)
        parts.setdefault(key, []).append(entry)
    return [_group(dict(key), part, names) for key, part in parts.items()]


def _group(values: dict[str, str], part: Sequence[Entry], names: Names) -> Group:
    medians, worst = {}, {}
    for name in filter(None, names[:3]):
        numbers = [number for entry in part if (number := entry.number(name)) is not None]
        if numbers:
            least = names.largest and name == names.validation
            medians[name], worst[name] = float(np.median(numbers)), min(numbers) if least else max(numbers)
    return Group(values, sum(entry.status.state == "done" for entry in part), len(part), medians, worst)
