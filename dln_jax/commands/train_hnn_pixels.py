"""Train a Hamiltonian network, or a plain one, on films of a pendulum: an autoencoder with an energy in its plane.

The films are generated: 28 x 28 pixels of a swinging rod. A run folder gets config.json, metrics.json,
model.safetensors and model.json (load them with dln_jax.load), a checkpoint to --resume from, and figures.
"""

from dataclasses import dataclass

from dln_jax.command_line.arguments import Unstated
from dln_jax.command_line.options import Drawn, Resumable
from dln_jax.command_line.running import stored_arguments
from dln_jax.files import write_json
from dln_jax.models.latent_phase import Field
from dln_jax.runs.frames import train_into
from dln_jax.studies.hamiltonian.pixels import STEPS, pixel_data
from dln_jax.types import require_positive, require_seed
from dln_jax.zoo.run_folder import CONFIG, run_folder


@dataclass(frozen=True)
class Arguments(Resumable, Drawn):
    """What to train on, how, and where the results go."""

    model: Field = "black-box-hnn"
    """An energy in the latent plane, or a network that gives the rates there."""
    trajectories: Unstated[int] = None
    """Generated films (default: as published)."""
    steps: Unstated[int] = None
    """Steps of adam (default: those of the published recipe)."""
    seed: int = 0
    """Of the initial parameters and the shuffling; 0 to 4294967295."""


def main(given: Arguments) -> None:
    """Trains, evaluates, and writes the run folder."""
    require_seed(given.seed)
    steps = STEPS if given.steps is None else given.steps
    require_positive(steps=steps)
    if given.trajectories is not None:
        require_positive(trajectories=given.trajectories)
    data = pixel_data(given.trajectories)
    with run_folder(given.out, "train_hnn_pixels", resume=given.resume) as folder:
        write_json(folder / CONFIG, stored_arguments(given))
        options = {"seed": given.seed, "steps": steps, "resume": given.resume, "figures": given.figures}
        train_into(folder, given.model, data, **options)
