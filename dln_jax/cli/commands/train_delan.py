"""Train a model of dynamics on trajectories (q, qd, qdd, tau), and report its errors, its rollouts and its speed.

Models: structured-delan (a deep Lagrangian network, M = L Lᵀ), black-box-delan (a network is the Lagrangian),
trigonometric (linear in its parameters, one least-squares problem), trigonometric-kernel (the same energies of six or
seven joints, as a Gaussian process), learned-tree (an arm's bodies and joint frames, found from random starts),
feed-forward (no physics), and auto, the default for --data: a ladder of those that the data allow, from the tree of
--robot to a network, of which the first that no other betters on validation motions is kept. Data are an npz or CSV
file with t, q and tau; joints have friction unless --needs or the file says otherwise. Without --data it trains on
the embedded set: the tip of a two-link arm writes 20 letters, of which e, q and v are the test. A run folder gets
config.json, metrics.json, model.safetensors and model.json (load them with dln_jax.load), a checkpoint to --resume
from, and figures. For Hamiltonian networks see train_hnn.
"""

from dataclasses import dataclass
from typing import Literal

from dln_jax.cli.arguments import Unstated
from dln_jax.training.dynamics.options import ArmOptions
from dln_jax.training.dynamics.run import run


@dataclass(frozen=True)
class Arguments(ArmOptions):
    """What to train on, how, and where the results go."""

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
    """What is learned; auto: several models, of which validation chooses one (default: auto for --data, unless an
    option of networks is given; structured-delan for the embedded letters and scenes)."""


def main(given: Arguments) -> None:
    """Trains and evaluates the model, and writes the run folder."""
    run(given, "train_delan")
