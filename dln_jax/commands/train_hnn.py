"""Train a Hamiltonian network on a log with torques.

Models: structured-hnn (H = ½ pᵀ M⁻¹(q) p + V(q)) and black-box-hnn (a network is H). Data with momenta p are fitted in
Hamilton's equations, (q, p, tau) -> (qd, qdd). Without momenta, torques are fitted through the Legendre transform. The
table reports errors of torques and accelerations in coordinates and velocities, as for every model. Without --data, it
trains on the built-in letters. The run folder gets the same files as that of train_delan. For motions without applied
forces use train_hnn_task.
"""

from dataclasses import dataclass
from typing import Literal

from dln_jax.commands.train_delan import NetworkOptions, train


@dataclass(frozen=True)
class Arguments(NetworkOptions):
    """What to train on, how, and where the results go."""

    model: Literal["structured-hnn", "black-box-hnn"] = "structured-hnn"  # type: ignore[assignment]
    """Model to learn."""


def main(options: Arguments) -> None:
    """Trains and evaluates the model, and writes the run folder; `InputError` for data without tau."""
    train(options, "train_hnn")
