"""Measure what several devices of one process gain over one device.

Subjects: crawlers (soft bodies stepped side by side, 64 to 4096) and training (a small network by Adam and by
Gauss-Newton). One device and several take turns; compilation is apart, results are waited for, medians count.
"""

from dataclasses import dataclass
from typing import Annotated

from dln_jax.cli.arguments import Unstated, choice, names_in
from dln_jax.cli.options import Folder
from dln_jax.scale.processes import host_devices
from dln_jax.types import InputError, require_positive
from scripts.reports.case import in_subjects, report_cases
from scripts.reports.scale import cases

SUBJECTS = ("crawlers", "training")


@dataclass(frozen=True)
class Arguments(Folder):
    """What to measure."""

    only: Annotated[str, choice(SUBJECTS, several=True)] = ",".join(SUBJECTS)
    """Subjects (default: all)."""
    lanes: Unstated[str] = None
    """Numbers of crawlers side by side, separated by commas (default: 64,512,4096)."""
    sharing: int = 2
    """Devices that share the work."""
    quick: bool = False
    """16 crawlers, two steps and two turns: a look at whether everything runs, in a minute."""


def main(options: Arguments) -> None:
    """Measures, prints and writes."""
    subjects = names_in("--only", options.only, SUBJECTS)
    require_positive(sharing=options.sharing)
    chosen = cases(quick=options.quick, lanes=lanes_in(options.lanes), count=options.sharing)
    host_devices(options.sharing)
    report_cases(options, "scale_report", in_subjects(chosen, subjects), dtype="float64", seeds=[0])


def lanes_in(text: str | None) -> tuple[int, ...] | None:
    """Parses --lanes; `InputError` unless it lists positive whole numbers."""
    if text is None:
        return None
    numbers = tuple(int(word) if word.strip().isdecimal() and len(word) < 10 else 0 for word in text.split(","))
    if 0 in numbers:
        raise InputError(f"--lanes is {text!r:.60}; expected positive whole numbers, separated by commas")
    return numbers
