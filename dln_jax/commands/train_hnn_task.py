"""Train a Hamiltonian model of motions without applied forces, (q, p) -> (qd, pd), and report how it predicts them.

Tasks are the published spring, pendulum, real-pendulum (--data), two-body and three-body; damped-spring,
damped-pendulum, henon-heiles and double-pendulum; and measured: any --data in the npz schema, with q, qd or only q,
whose windows never cross a gap. Models: auto (what suits the scene), separable-hnn (T(p) + V(q)), structured-hnn,
black-box-hnn, pairwise-hnn (bodies), polynomial-hamiltonian (one least-squares problem) and phase-network (a network
gives the rates). Friction is learned where the needs state it. Load the model with dln_jax.load.
"""

from dataclasses import dataclass

from dln_jax.command_line.options import Drawn, Resumable, SingleCalls
from dln_jax.command_line.running import CHOSEN, stored_arguments
from dln_jax.files import write_json
from dln_jax.runs.phase_space import train_into
from dln_jax.runs.phase_space_task import Options, prepare
from dln_jax.zoo.run_folder import CONFIG, run_folder


@dataclass(frozen=True)
class Arguments(Options, Resumable, Drawn, SingleCalls):
    """What to train on, how, and where the results go."""


def main(given: Arguments) -> None:
    """Trains, evaluates, and writes the run folder."""
    task = prepare(given)
    wanted = {"figures": given.figures, "low_latency": given.low_latency}
    with run_folder(given.out, "train_hnn_task", resume=given.resume) as folder:
        write_json(folder / CONFIG, {**stored_arguments(given), CHOSEN: task.description})
        train_into(folder, task, resume=given.resume, **wanted)
