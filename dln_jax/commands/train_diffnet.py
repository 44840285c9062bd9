"""Train a deep differential network, or an ensemble, on a function: value, gradient and Hessian from one pass.

Functions: sin (1-D), cos_sin (cos x1 sin x2), both with the published noise, or your own npz file with x [N, n],
y [N, m] and optional dy, d2y. A run folder gets config.json, metrics.json, model.safetensors and model.json (load them
with dln_jax.load), and figures. For the published table of activations and losses see diffnet_table.
"""

from dataclasses import dataclass
from typing import ClassVar

from dln_jax.training.functions.options import VARIANTS, Options


@dataclass(frozen=True)
class Arguments(Options):
    """What to train on, how, and where the results go."""

    VARIANTS: ClassVar = VARIANTS


def main(options: Arguments) -> None:
    """Trains and evaluates the network, and writes the run folder."""
    from dln_jax.training.functions.run import FUNCTIONS
    from dln_jax.training.pipeline import train

    train(FUNCTIONS, options, "train_diffnet")
