"""Measure what devices and processes that share work gain over one device, and model it for many hosts.

Subjects: crawlers (soft bodies stepped side by side, 64 to 4096), training (a small network by Adam and by
Gauss-Newton), accelerator (both, and torques of a batch, against the processor; nothing where JAX sees none). One
device, several of one process, and several processes take turns; compilation is apart, results are waited for, medians
count. What n hosts would gain is a model of these seconds and of an assumed network, and is not measured. Writes
report.json, metrics.json and figures.
"""

from dataclasses import dataclass
from typing import Annotated

from dln_jax.cli.arguments import Unstated, choice, names_in
from dln_jax.cli.options import Drawn, Folder
from dln_jax.cli.stored_arguments import command_folder
from dln_jax.files import finite, write_json
from dln_jax.types import InputError, require_positive
from scripts.reports.case import draw, measure, rows_in
from scripts.reports.rows import conditions, markdown, publish
from scripts.reports.scale.cases import cases
from scripts.reports.scale.hosts import CASES, NETWORKS

SUBJECTS = ("crawlers", "training", "accelerator")


@dataclass(frozen=True)
class Arguments(Folder, Drawn):
    """What to measure."""

    only: Annotated[str, choice(SUBJECTS, several=True)] = ",".join(SUBJECTS)
    """Subjects (default: all)."""
    lanes: Unstated[str] = None
    """Numbers of crawlers side by side, separated by commas (default: 64,512,4096)."""
    sharing: int = 2
    """Devices of one process, and processes, that share the work."""
    quick: bool = False
    """16 crawlers, two steps and two turns: a look at whether everything runs, in a minute."""


def main(options: Arguments) -> None:
    """Measures, prints and writes."""
    subjects = names_in("--only", options.only, SUBJECTS)
    require_positive(sharing=options.sharing)
    chosen = cases(quick=options.quick, lanes=lanes_in(options.lanes), count=options.sharing)
    chosen = [case for case in chosen if case.name in subjects]
    with command_folder(options, "scale_report") as folder:
        say = lambda done: print(f"{done.place}  {done.case.name}  {done.seconds:.0f} s", flush=True)  # noqa: E731
        results = measure(chosen, say)
        if "accelerator" in results and not results["accelerator"].rows:
            print("accelerator: not measured, JAX sees none")
        if options.figures:
            for case in chosen:
                draw(folder, case, results[case.name])
        rows = rows_in(results)
        networks = {name: network._asdict() for name, network in NETWORKS.items()}
        assumed = "network of hosts/...: bit/s and s of a message, assumed; what n hosts gain is computed, not measured"
        dtype = "float64, and float32 where a case says so"
        facts = conditions(dtype=dtype, seeds=[0], networks=networks, assumed=assumed)
        write_json(folder / "metrics.json", {f"{row.case}/{row.quantity}": finite(row.value) for row in rows})
        modelled = [row for row in rows if row.case.startswith(CASES)]
        shown = [row for row in rows if row not in modelled]
        publish(folder, rows, facts, shown=shown, tables=[markdown(modelled)] if modelled else [])


def lanes_in(text: str | None) -> tuple[int, ...] | None:
    """Parses --lanes; `InputError` unless it lists positive whole numbers."""
    if text is None:
        return None
    numbers = tuple(int(word) if word.strip().isdecimal() and len(word) < 10 else 0 for word in text.split(","))
    if 0 in numbers:
        raise InputError(f"--lanes is {text!r:.60}; expected positive whole numbers, separated by commas")
    return numbers
