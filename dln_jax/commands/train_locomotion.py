"""Train a policy that moves a soft creature, by gradients through the simulator.

The creature starts on the ground and has an episode of 400 steps of 0.033 s. A policy is judged by how many body
lengths the mean x of the vertices travels before the creature falls, if it does. The policy observes the body in its
own frame and a clock, and changes the actuation of the muscles, 0.25 to 1 of their rest length, by at most 0.3 a step.
Episodes may start perturbed, on slopes or rough ground, and be disturbed by pushes. Then the policy is selected by 16
walks of five episodes on the steepest slopes, and judged by 100 others of 2,000 steps. A run folder gets config.json,
metrics.json, the model of the best seed, a figure of the learning, and a GIF of the gait. evaluate_locomotion judges
the policy on other ground.
"""

from dataclasses import dataclass
from pathlib import Path

from dln_jax.options import Unstated
from dln_jax.runs.options import Drawn, Resumable, Scaled
from dln_jax.training.locomotion_options import LocomotionOptions


@dataclass(frozen=True)
class Arguments(LocomotionOptions, Resumable, Drawn, Scaled):
    """What to train, how, and where the results go."""

    stored: Unstated[Path] = None
    """Folder of a run whose policy is trained further, perhaps on other ground (default: a new policy)."""


def main(options: Arguments) -> None:
    """Trains and evaluates the policy, and writes the run folder."""
    from dln_jax.locomotion.gradient import settings_of
    from dln_jax.runs.report import print_numbers
    from dln_jax.runs.scaled import mesh_of
    from dln_jax.runs.stored_arguments import command_folder
    from dln_jax.training.locomotion import announce, prepare, trained, write_run
    from dln_jax.training.locomotion_evaluation import parameters_for

    mesh = mesh_of(options)
    task = prepare(options, mesh)
    initial = None if options.stored is None else parameters_for(task, options.width, options.stored)
    with command_folder(options, "train_locomotion") as folder:
        announce(task)
        policies = trained(task, options, mesh, initial=initial, directory=folder, resume=options.resume)
        settings = {"width": options.width, **settings_of(options.window, options.lanes)._asdict()}
        numbers = write_run(folder, task, policies, settings, figures=options.figures)
        rows = [(name.replace("_", " "), f"{value:.4g}") for name, value in numbers.items()]
        print_numbers(rows, title=f"{options.creature}, gradient", columns=("quantity", "value"))
        print(f"run folder: {folder}")
