"""Swing up a pole with a model that was learned from it: explore the plant, learn, design a controller, close the loop.

The simulated plants have dry friction, limits, encoders, noise and torques that act a sample late, at 500 Hz. A rough
model explores; only q and the commanded torques are recorded. Models: delan (a structured deep Lagrangian network with
friction), identified (linear in its parameters), analytic (the nominal dimensions, no friction), known (the plant
itself). All use the same energy law, regulator and friction compensation, with the same gains. A run folder gets
data.npz, the model, metrics.json, config.json, and a figure and an animation of the runs.
"""

from dataclasses import dataclass
from typing import Annotated

from dln_jax.cli.arguments import choice
from dln_jax.cli.options import Drawn, Folder


@dataclass(frozen=True)
class Arguments(Folder, Drawn):
    """Plant, model, and where the results go."""

    plant: Annotated[str, choice(("rotary-pendulum", "cart-pole", "furuta"))] = "rotary-pendulum"
    """The plant; furuta is another name of the rotary pendulum."""
    model: Annotated[str, choice(("delan", "identified", "analytic", "known"))] = "delan"
    """The model from which the controller is designed."""
    seconds_of_data: float = 30.0
    """Seconds of motion to learn from, at 500 Hz, including an episode for validation."""
    starts: int = 100
    """Number of starts near hanging at rest."""
    seed: int = 0
    """Seed of the exploration, the network's initial parameters, the starts and the noise."""


def main(options: Arguments) -> None:
    """Explores the plant, learns the model, swings up and writes the run folder."""
    from dln_jax.cli.stored_arguments import command_folder
    from dln_jax.training.swing_ups.run import asked, swing_up

    task = asked(options.plant, options.model, options.seconds_of_data, options.starts, options.seed)
    with command_folder(options, "swing_up") as folder:
        swing_up(task, folder, figures=options.figures)
        print(f"run folder: {folder}")
