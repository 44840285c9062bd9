"""Train a Hamiltonian network on trajectories with torques, and report its errors, its rollouts and its speed.

Models: structured-hnn (H = ½ pᵀ M⁻¹(q) p + V(q)) and black-box-hnn (a network is H). Data with momenta p are fitted in
Hamilton's equations, (q, p, tau) -> (qd, qdd); without them torques are fitted, through the Legendre transform. Errors
are those of torques and accelerations in coordinates and velocities, as for every model. Without --data it trains on
the embedded letters; a run folder gets what train_delan writes. Motions without applied forces are for train_hnn_task.
"""

from dataclasses import dataclass
from typing import ClassVar, Literal

from dln_jax.command_line.options import Drawn, Resumable, SingleCalls
from dln_jax.runs.dynamics import train_into
from dln_jax.runs.dynamics_task import Options, prepare
from dln_jax.zoo.run_folder import run_folder


@dataclass(frozen=True)
class Arguments(Options, Resumable, Drawn, SingleCalls):
    """What to train on, how, and where the results go."""

    MOVED: ClassVar = {"--task": "train_hnn_task --task NAME, and train_hnn_pixels for pixels"}

    model: Literal["structured-hnn", "black-box-hnn"] = "structured-hnn"
    """What is learned."""


def main(given: Arguments) -> None:
    """Trains, evaluates, and writes the run folder."""
    task = prepare(given)
    wanted = {"figures": given.figures, "low_latency": given.low_latency}
    with run_folder(given.out, "train_hnn", resume=given.resume) as folder:
        train_into(folder, task, given, resume=given.resume, **wanted)
