"""Train a Hamiltonian network on trajectories with torques, and report its errors, its rollouts and its speed.

Models: structured-hnn (H = ½ pᵀ M⁻¹(q) p + V(q)) and black-box-hnn (a network is H). Data with momenta p are fitted in
Hamilton's equations, (q, p, tau) -> (qd, qdd); without them torques are fitted, through the Legendre transform. Errors
are those of torques and accelerations in coordinates and velocities, as for every model. Without --data it trains on
the embedded letters; a run folder gets what train_delan writes. Motions without applied forces are for train_hnn_task.
"""

from dataclasses import dataclass
from typing import Literal

from dln_jax.data import schema
from dln_jax.training.dynamics.options import Options
from dln_jax.training.dynamics.run import run
from dln_jax.types import InputError


@dataclass(frozen=True)
class Arguments(Options):
    """What to train on, how, and where the results go."""

    model: Literal["structured-hnn", "black-box-hnn"] = "structured-hnn"
    """What is learned."""


def main(given: Arguments) -> None:
    """Trains and evaluates the model, and writes the run folder; `InputError` for data without tau."""
    if given.data is not None and "tau" in schema.load(given.data).estimated:
        raise InputError(
            f"{given.data} has no tau, which train_hnn is fitted to; motions without applied forces are for "
            f"train_hnn_task --task measured --data {given.data}"
        )
    run(given, "train_hnn")
