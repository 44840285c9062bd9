"""Train a Hamiltonian network, or a plain one, on films of a pendulum: an autoencoder with an energy in its plane.

The films are generated: 28 x 28 pixels of a swinging rod. A run folder gets config.json, metrics.json,
model.safetensors and model.json (load them with dln_jax.load), a checkpoint to --resume from, and figures.
"""

from dataclasses import dataclass

from dln_jax.training.hamiltonian.options import ImageOptions


@dataclass(frozen=True)
class Arguments(ImageOptions):
    """What to train on, how, and where the results go."""


def main(options: Arguments) -> None:
    """Trains and evaluates the model, and writes the run folder."""
    from dln_jax.training.hamiltonian.pixels import IMAGES
    from dln_jax.training.pipeline import train

    train(IMAGES, options, "train_hnn_pixels")
