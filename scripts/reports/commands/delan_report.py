"""Measure DeLaN on letters: by the published protocol, from few letters, at other speeds, and learning in the loop.

`published` trains the structured DeLaN as the published implementation does (64x64 tanh, batch 512, 20,000 steps,
float32) and checks the generic mechanics against the closed form of the arm. `letters`, `speeds` and `online` are the
experiments of the first DeLaN paper (Lutter, Ritter and Peters 2019): torque errors against the number of training
letters, torque errors at 0.5 to 2 times the speed, and tracking errors of an arm that learns its model while it writes;
each beside a feed-forward network and an identified arm. Prints a table and writes report.json.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from dln_jax.cli.arguments import Unstated, choice, names_in
from dln_jax.cli.options import Folder
from dln_jax.data.splits import split
from dln_jax.scenes.datasets.generators import CHARACTERS_TEST
from dln_jax.types import require_positive
from scripts.reports.arm import few_letters, learning_online, published_protocol
from scripts.reports.arm.table import letters
from scripts.reports.case import Case, report_cases

SUBJECTS = ("published", "letters", "speeds", "online")
QUICK_STEPS = 500
"""Adam steps with --quick."""


@dataclass(frozen=True)
class Arguments(Folder):
    """What to measure, and on which letters."""

    MEASURES_COMPILATION: ClassVar = True

    only: Annotated[str, choice(SUBJECTS, several=True)] = ",".join(SUBJECTS)
    """Subjects (default: all)."""
    data: Unstated[Path] = None
    """Trajectories of the two-link arm in the npz schema (default: the embedded letters)."""
    test: str = ",".join(CHARACTERS_TEST)
    """Labels of the test trajectories, comma separated; `letters` and `speeds` add other splits of the same size."""
    seeds: int = 1
    """Number of seeds of `published`, from 0 upwards; each also draws its own validation letters."""
    steps: int = 20_000
    """Optimiser steps of `published`."""
    quick: bool = False
    """Fewer seeds, splits, letters and iterations: to try the command."""


def main(options: Arguments) -> None:
    """Measures, prints and writes."""
    require_positive(seeds=options.seeds, steps=options.steps)
    subjects = names_in("--only", options.only, SUBJECTS)
    data, name = letters(options.data), "embedded-letters" if options.data is None else options.data.stem
    test = options.test.split(",")
    sets = [split(data, test=test, seed=seed) for seed in range(options.seeds)]
    steps = min(options.steps, QUICK_STEPS) if options.quick else options.steps
    by_subject: dict[str, Callable[[], list[Case]]] = {
        "published": lambda: published_protocol.cases(name, sets, steps=steps),
        "letters": lambda: [few_letters.against_letters(name, data, test, quick=options.quick)],
        "speeds": lambda: [few_letters.at_speeds(name, data, test, quick=options.quick)],
        "online": lambda: learning_online.cases(name, data, quick=options.quick),
    }
    report_cases(
        options, "delan_report", [case for subject in subjects for case in by_subject[subject]()],
        dtype="float64; published protocol float32", seeds=list(range(options.seeds)), call_path="default jit",
        data="embedded letters" if options.data is None else options.data.name,
    )  # fmt: skip
