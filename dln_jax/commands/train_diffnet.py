"""Train a deep differential network, or an ensemble, on a function: value, gradient and Hessian from one pass.

Functions: sin (1-D), cos_sin (cos x1 sin x2), both with the published noise, or an npz file of one's own with x [N, n],
y [N, m] and optional dy, d2y. A run folder gets config.json, metrics.json, model.safetensors and model.json (load them
with dln_jax.load), and figures. For the published table of activations and losses see diffnet_table.
"""

from dataclasses import dataclass
from typing import ClassVar

from dln_jax.command_line.options import Drawn, Resumable
from dln_jax.runs.function_task import Options, prepare
from dln_jax.runs.functions import train_into
from dln_jax.zoo.run_folder import run_folder


@dataclass(frozen=True)
class Arguments(Options, Resumable, Drawn):
    """What to train on, how, and where the results go."""

    MOVED: ClassVar = {"--table": "diffnet_table"}


def main(given: Arguments) -> None:
    """Trains, evaluates, and writes the run folder."""
    task = prepare(given)
    with run_folder(given.out, "train_diffnet", resume=given.resume) as folder:
        train_into(folder, task, given, resume=given.resume, figures=given.figures)
