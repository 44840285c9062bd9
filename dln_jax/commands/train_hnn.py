"""Train a Hamiltonian network on trajectories with torques, and report its errors, its rollouts and its speed.

Models: structured-hnn (H = ½ pᵀ M⁻¹(q) p + V(q)) and black-box-hnn (a network is H). Data with momenta p are fitted in
Hamilton's equations, (q, p, tau) -> (qd, qdd); without them torques are fitted, through the Legendre transform. Errors
are those of torques and accelerations in coordinates and velocities, as for every model. Without --data it trains on
the embedded letters; a run folder gets what train_delan writes. Motions without applied forces are for train_hnn_task.
"""

from dataclasses import dataclass
from typing import ClassVar, Literal

from dln_jax.errors import InputError
from dln_jax.training.dynamics.options import VARIANTS, Options


@dataclass(frozen=True)
class Arguments(Options):
    """What to train on, how, and where the results go."""

    VARIANTS: ClassVar = VARIANTS
    model: Literal["structured-hnn", "black-box-hnn"] = "structured-hnn"
    """Model to learn."""


def main(options: Arguments) -> None:
    """Trains and evaluates the model, and writes the run folder; `InputError` for data without tau."""
    from dln_jax.data import schema
    from dln_jax.runs.encoders import facts
    from dln_jax.training.dynamics.run import run

    if options.data is not None and "tau" in schema.load(options.data, **facts(options)).estimated:
        raise InputError(
            f"{options.data} has no tau, which train_hnn is fitted to; motions without applied forces are for "
            f"train_hnn_task --task measured --data {options.data}"
        )
    run(options, "train_hnn")
