"""Train a Hamiltonian network on trajectories, and report its errors, its rollouts and its speed.

Models: structured (H = ½ pᵀ M⁻¹(q) p + V(q)) and black-box (a network is H). Data with momenta p are fitted in
Hamilton's equations, (q, p, tau) -> (qd, qdd); without them torques are fitted, through the Legendre transform. Errors
are those of torques and accelerations in coordinates and velocities, as for every model. Without --data it trains on
the embedded letters; a run folder gets what train_delan writes.
"""

from dataclasses import dataclass
from typing import Literal

from scripts import dynamics_training
from scripts.command_line import run

KINDS = {"structured": "structured-hnn", "black-box": "black-box-hnn"}


@dataclass(frozen=True)
class Arguments(dynamics_training.Arguments):
    """What to train on, how, and where the results go."""

    model: Literal["structured", "black-box"] = "structured"
    """What is learned."""


def main(given: Arguments) -> None:
    """Trains, evaluates, and writes the run folder."""
    dynamics_training.run_training(given, "train_hnn", KINDS)


if __name__ == "__main__":
    run(main, Arguments)
