"""Train a deep differential network, or an ensemble, on a function: value, gradient and Hessian from one pass.

Functions: sin (1-D), cos_sin (cos x1 sin x2), both with the published noise, or an npz file of one's own with x [N, n],
y [N, m] and optional dy, d2y. A run folder gets config.json, metrics.json, model.safetensors and model.json (load them
with dln_jax.load), and figures. For the published table of activations and losses see diffnet_table.
"""

from dln_jax.training.functions.run import run
from dln_jax.training.functions.task import Options as Arguments


def main(given: Arguments) -> None:
    """Trains and evaluates the network, and writes the run folder."""
    run(given, "train_diffnet")
