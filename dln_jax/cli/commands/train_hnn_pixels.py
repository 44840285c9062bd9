"""Train a Hamiltonian network, or a plain one, on films of a pendulum: an autoencoder with an energy in its plane.

The films are generated: 28 x 28 pixels of a swinging rod. A run folder gets config.json, metrics.json,
model.safetensors and model.json (load them with dln_jax.load), a checkpoint to --resume from, and figures.
"""

from dln_jax.training.hamiltonian.images import Options as Arguments
from dln_jax.training.hamiltonian.images import run


def main(given: Arguments) -> None:
    """Trains and evaluates the model, and writes the run folder."""
    run(given, "train_hnn_pixels")
