"""Train a Hamiltonian model of motions without applied forces, (q, p) -> (qd, pd), and report how it predicts them.

Tasks are the published spring, pendulum, real-pendulum (--data), two-body and three-body; damped-spring,
damped-pendulum, henon-heiles and double-pendulum; and measured: any --data in the npz schema, with q, qd or only q,
whose windows never cross a gap. Models: auto (the one that suits the scene), separable-hnn (T(p) + V(q)),
structured-hnn, black-box-hnn, pairwise-hnn (bodies), polynomial-hamiltonian (one least-squares problem), phase-network
(a network gives the rates) and helmholtz-hnn (the gradients of two networks give them, friction included). Friction is
learned where the needs state it. Load the model with dln_jax.load.
"""

from dataclasses import dataclass
from typing import ClassVar

from dln_jax.training.hamiltonian.options import VARIANTS, Options


@dataclass(frozen=True)
class Arguments(Options):
    """What to train on, how, and where the results go."""

    VARIANTS: ClassVar = VARIANTS


def main(options: Arguments) -> None:
    """Trains and evaluates the model, and writes the run folder."""
    from dln_jax.training.hamiltonian.run import PHASE_SPACE
    from dln_jax.training.pipeline import train

    train(PHASE_SPACE, options, "train_hnn_task")
