"""Swing up a pole by a model that was learned from it: explore the plant, learn, make a controller, close the loop.

Plants are simulated as they stand on a desk: dry friction, limits, encoders, noise, torques a sample late, at 500 Hz.
A rough model explores; q and the torques asked for are all that is recorded. Models: delan (a structured deep
Lagrangian network with friction), identified (linear in its parameters), analytic (the nominal sizes, no friction),
known (the plant itself). Each gets the same energy law, regulator and friction compensation, with the same gains. A run
folder gets data.npz, the model, metrics.json, config.json, and a figure and a film of the runs.
"""

from dataclasses import dataclass
from typing import Annotated

from dln_jax.cli.arguments import choice
from dln_jax.cli.options import Drawn, Folder
from dln_jax.cli.stored_arguments import command_folder
from dln_jax.control.desktop_plants import NAMES
from dln_jax.training.swing_ups.learned import MODELS
from dln_jax.training.swing_ups.run import asked, swing_up


@dataclass(frozen=True)
class Arguments(Folder, Drawn):
    """Plant, model, and where the results go."""

    plant: Annotated[str, choice(NAMES)] = "rotary-pendulum"
    """The plant; furuta is the rotary pendulum by its other name."""
    model: Annotated[str, choice(MODELS)] = "delan"
    """What the controller is made of."""
    seconds_of_data: float = 30.0
    """Seconds of motion to learn from, at 500 Hz; an episode of them is to select by."""
    starts: int = 100
    """Starts near hanging at rest."""
    seed: int = 0
    """Of the exploration, the network's initial parameters, the starts and the noise."""


def main(given: Arguments) -> None:
    """Explores the plant, learns the model, swings up and writes the run folder."""
    checked = asked(given.plant, given.model, given.seconds_of_data, given.starts, given.seed)
    with command_folder(given, "swing_up") as folder:
        swing_up(checked, folder, figures=given.figures)
        print(f"run folder: {folder}")
