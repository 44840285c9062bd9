"""Train a Hamiltonian network on trajectories, and report its errors, its rollouts and its speed.

Without --task, models of torques: structured (H = ½ pᵀ M⁻¹(q) p + V(q)) and black-box (a network is H). Data with
momenta p are fitted in Hamilton's equations, (q, p, tau) -> (qd, qdd); without them torques are fitted, through the
Legendre transform. Errors are those of torques and accelerations in coordinates and velocities, as for every model.
Without --data it trains on the embedded letters; a run folder gets what train_delan writes.

With --task, models of a phase space without applied forces: (q, p) -> (qd, pd). Tasks are the published spring,
pendulum, real-pendulum (--data), two-body, three-body and pixels; damped-spring, damped-pendulum, henon-heiles and
double-pendulum; and measured: any --data in the npz schema, with q, qd or only q, whose windows never cross a gap.
Models: auto (what suits the scene), separable (T(p) + V(q)), structured, black-box, pairwise (bodies), polynomial (one
least-squares problem) and baseline (a network gives the rates). Friction is learned where the needs state it.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

from dln_jax.command_line.arguments import Unstated, choice, refuse_given
from dln_jax.command_line.running import with_stored_arguments
from dln_jax.runs import dynamics as dynamics_training
from dln_jax.runs import frames as pixel_training
from dln_jax.runs import phase_space as phase_training
from dln_jax.studies.hamiltonian.tasks import PIXELS, TASKS

KINDS = {"auto": "structured-hnn", "structured": "structured-hnn", "black-box": "black-box-hnn"}


@dataclass(frozen=True)
class Arguments(dynamics_training.Arguments):
    """What to train on, how, and where the results go."""

    model: Literal["auto", "separable", "structured", "black-box", "pairwise", "polynomial", "baseline"] = "auto"
    """What is learned; without --task structured (auto) or black-box."""
    task: Annotated[str | None, choice((*TASKS, PIXELS), unstated=True)] = None
    """Task of a phase space, in place of torques."""
    trajectories: Unstated[int] = None
    """--task: generated trajectories (default: the task's own number)."""


def main(given: Arguments) -> None:
    """Trains, evaluates, and writes the run folder."""
    if given.resume:
        given = with_stored_arguments(given)
    if given.task is None:
        refuse_given(given, ["trajectories"], "for a --task")
        dynamics_training.run_training(given, "train_hnn", KINDS)
    elif given.task == PIXELS:
        pixel_training.run_pixels(given)
    else:
        phase_training.run_task(given)
