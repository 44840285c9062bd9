"""Train a policy that moves a soft creature: by gradients through the simulator, or by evolution.

The creature starts at rest on the ground and has an episode of 80 steps of 0.033 s; policies are judged by how many
body lengths the mean x of its vertices travels before it falls, if it does. The policy sees the body and a clock, and
sets the actuation of the muscles, 0.25 to 1 of their rest length. A run folder gets config.json, metrics.json, the
model of the best seed, a figure of the learning, and a GIF of the gait.
"""

from dataclasses import dataclass
from typing import Literal

from dln_jax.cli.arguments import refuse_given
from dln_jax.cli.options import Drawn, Resumable, Scaled
from dln_jax.cli.scaled import mesh_of
from dln_jax.cli.stored_arguments import command_folder
from dln_jax.locomotion.methods import settings_of
from dln_jax.training.locomotion import Options, announce, learned, prepare, write_run
from dln_jax.training.results import print_numbers

UNUSED = {"gradient": (), "evolution": ("window",)}
"""Options that are refused with a method because it does not use them."""


@dataclass(frozen=True)
class Arguments(Options, Resumable, Drawn, Scaled):
    """What to train, how, and where the results go."""

    method: Literal["gradient", "evolution"] = "gradient"
    """How to learn."""


def main(given: Arguments) -> None:
    """Trains and evaluates the policy, and writes the run folder."""
    refuse_given(given, UNUSED[given.method], f"not used by --method {given.method}")
    mesh = mesh_of(given)
    task = prepare(given, [given.method], mesh)
    with command_folder(given, "train_locomotion") as folder:
        announce(task)
        trained = learned(task, given.method, given, mesh, directory=folder, resume=given.resume)
        settings = settings_of(given.method, given.creature, given.window, given.lanes)
        numbers = write_run(folder, task, given.method, trained, given, settings, figures=given.figures)
        rows = [(name.replace("_", " "), f"{value:.4g}") for name, value in numbers.items()]
        print_numbers(rows, title=f"{given.creature}, {given.method}", columns=("quantity", "value"))
        print(f"run folder: {folder}")
