"""Train a model of dynamics on trajectories (q, qd, qdd, tau), and report its errors, its rollouts and its speed.

Models: structured-delan (a deep Lagrangian network, M = L Lᵀ), black-box-delan (a network is the Lagrangian),
trigonometric (linear in its parameters), trigonometric-kernel (the same energies as a Gaussian process), learned-tree
(bodies and joint frames of an arm), feed-forward (no physics), and auto, the default for --data: model selection by
validation motions. Each model has options of its own: --model NAME --help shows them. Without --data the embedded set
is used: the tip of a two-link arm writes 20 letters. Load the run with dln_jax.load.
"""

from dataclasses import dataclass
from typing import ClassVar, Literal

from dln_jax.runs.arguments import Unstated
from dln_jax.training.dynamics.options import VARIANTS, Options


@dataclass(frozen=True)
class Arguments(Options):
    """What to train on, how, and where the results go."""

    VARIANTS: ClassVar = VARIANTS
    model: Unstated[
        Literal[
            "structured-delan",
            "black-box-delan",
            "trigonometric",
            "trigonometric-kernel",
            "learned-tree",
            "feed-forward",
            "auto",
        ]
    ] = None
    """Model to learn; auto: validation chooses among several models (default: auto for --data,
    structured-delan for the embedded letters and scenes)."""


def main(options: Arguments) -> None:
    """Trains and evaluates the model, and writes the run folder."""
    from dln_jax.training.dynamics.run import run

    run(options, "train_delan")
