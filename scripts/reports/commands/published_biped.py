"""Walk with the published biped's policy (J. Rojas, algovivo): from rest, and from 100 perturbed starts.

The file has the arrays biped_vertices, biped_triangles, biped_muscles and those of biped_policy_. Prints how far the
biped walks in 2,000 steps and how often it falls, on the flat and on slopes of 10 degrees, and writes report.json.
"""

from dataclasses import dataclass
from pathlib import Path

from dln_jax.cli.options import Folder
from dln_jax.cli.stored_arguments import command_folder
from dln_jax.data.arrays import load_file
from dln_jax.locomotion.gradient import shown_walk
from dln_jax.locomotion.perturbed import STEPS, numbers_of, perturbed_trials
from dln_jax.locomotion.worlds import Variation
from scripts.reports.locomotion.published import DISTANCE, KEYS, published_biped
from scripts.reports.rows import Row, conditions, print_report, write_report


@dataclass(frozen=True)
class Arguments(Folder):
    """The published biped, and where the results go."""

    data: Path = Path("creatures.npz")
    """File with the published biped and its policy."""


def main(options: Arguments) -> None:
    """Measures and writes the report."""
    data = load_file(options.data, lambda arrays: arrays, KEYS)
    task, policy, parameters = published_biped(data)
    with command_folder(options, "published_biped") as folder:
        walked = float(shown_walk(task, policy, parameters, STEPS).travelled.sum())
        case = "published-biped/rest"
        rows = [
            Row(case, "distance_body_lengths", walked, reference=DISTANCE),
            Row(case, "relative_difference", abs(walked / DISTANCE - 1), bound=0.02),
        ]
        for name, slope in (("flat", 0.0), ("slope-10", 10.0)):
            task, policy, parameters = published_biped(data, variation=Variation(start=0.01, slope=slope))
            numbers = numbers_of(perturbed_trials(task, policy, parameters))
            rows += [Row(f"published-biped/{name}", quantity, value) for quantity, value in numbers.items()]
        facts = conditions(dtype="float64", starts="vertices perturbed by 0.01 m and 0.1 m/s", steps=STEPS)
        write_report(folder / "report.json", rows, facts)
        print_report(rows, facts)
        print(f"run folder: {folder}")
