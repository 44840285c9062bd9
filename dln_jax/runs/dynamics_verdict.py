"""Whether a trained model of dynamics may be used: the verdict on its torques in motions that it was not fitted to."""

from typing import NamedTuple

import numpy as np
from jax.sharding import Mesh

from dln_jax.data.encoders.noise import torque_noise
from dln_jax.data.schema import Trajectories
from dln_jax.mechanics.equations import Driven
from dln_jax.metrics.errors import predictions
from dln_jax.metrics.verdict import FitRefused, HeldOut, Verdict, held_out, judge, verdict_metrics, worst
from dln_jax.precision import data_type
from dln_jax.runs.dynamics_options import Options
from dln_jax.runs.dynamics_task import Task


class Judged(NamedTuple):
    """The verdict, and the test motions' numbers that it rests on."""

    verdict: Verdict
    test: HeldOut
    validation_nmse: float
    """Mean over joints of the squared error over the torque's variance."""

    @property
    def metrics(self) -> dict[str, float | int]:
        """Entries of metrics.json."""
        nmse = {"test_nmse": float(np.mean(self.test.error / self.test.unit)), "validation_nmse": self.validation_nmse}
        return {**nmse, **verdict_metrics(self.test, self.verdict)}


def judge_torques(energies: Driven, task: Task, predicted: np.ndarray, *, mesh: Mesh | None) -> Judged:
    """The graver verdict of the test and the validation motions.

    Args:
        energies: the trained model.
        task: its data.
        predicted: its torques in the test motions [N, d].
        mesh: devices that share the samples.
    """
    validation = task.sets.validation
    chosen_by = predictions(energies, validation, data_type(task.precision), mesh=mesh)["tau"]
    of_test, of_validation = _numbers(task.sets.test, predicted), _numbers(validation, chosen_by)
    nmse = float(np.mean(of_validation.error / of_validation.unit))
    return Judged(worst(judge(of_test), judge(of_validation)), of_test, nmse)


def say(judged: Judged) -> None:
    """Prints the verdict, and in words an error that is no better than that of a constant torque."""
    if not judged.validation_nmse <= 1:
        print(
            f"warning: on validation motions the torque's mean square error is {judged.validation_nmse:.3g} times its "
            "variance: a constant torque would be closer than this model"
        )
    print(judged.verdict.line)


def refuse(judged: Judged, given: Options) -> None:
    """Raises `FitRefused` for a model that must not be used, unless the user asked for a short training."""
    if judged.verdict.level == "refused" and given.steps is None and given.seconds is None:
        raise FitRefused(judged.verdict)


def _numbers(data: Trajectories, predicted: np.ndarray) -> HeldOut:
    return held_out(predicted, data.tau, noise=torque_noise(data))
