"""Training and evaluation from Python: what the commands do, in memory."""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dln_jax.data.joints import needs_from_json
from dln_jax.data.log import Log, Parts, log_of, read_log, split_log
from dln_jax.data.robots import Robot, read_robot
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import Split, select_samples
from dln_jax.learning.engine.checkpoint import Context
from dln_jax.learning.fit import Fit, with_uncertainty
from dln_jax.learning.fits.settings import WAYS
from dln_jax.precision import require_double_precision
from dln_jax.process import deadline
from dln_jax.types import InputError
from dln_jax.zoo.run import Run, load

if TYPE_CHECKING:
    from dln_jax.runs.report import Report


def train(
    log: Log | Trajectories | str | Path,
    model: str = "auto",
    *,
    test: str | None = None,
    seed: int = 0,
    seconds: float | None = None,
    uncertainty: bool = True,
    say: Callable[[str], None] = lambda line: None,
    **settings: Any,
) -> Fit:
    """Fits a model of dynamics to a log, and evaluates it on held-out motions.

        fit = dln_jax.train(dln_jax.read_log("mine.csv"), seconds=60)
        fit.report.verdict, fit.report.metrics["torque_mse"], fit.dynamics.inverse_dynamics(q, qd, qdd)
        fit.save("runs/mine")

    Args:
        log: from `read_log`; or trajectories, or a file.
        model: "auto" for model selection, or one of `learning.fits.settings.WAYS`.
        test: test trajectories, as for `data.log.split_log`.
        seed: seed of parameters, shuffling and the validation split.
        seconds: time limit of the fit.
        uncertainty: estimate the uncertainty of the torques.
        say: takes lines on the progress, such as `print`.
        settings: fields of the class of the model in `learning.fits.settings`, such as `width`. The `optimizer` of a
            network may be any of optax: `optimizer=optax.adam(3e-4), steps=5000`.

    Raises:
        InputError: JAX without float64, an unknown model or setting, or data that the model cannot be fitted to.
    """
    from dln_jax.runs.evaluation import evaluate as evaluate_fit  # draws, which the import of dln_jax need not

    require_double_precision("train")
    if model not in WAYS:
        raise InputError(f"model is {model!r:.60}; expected one of {', '.join(WAYS)}")
    way = WAYS[model]
    known = [field.name for field in dataclasses.fields(way) if field.name != "model"]
    if unknown := [name for name in settings if name not in known]:
        raise InputError(f"{model} has no setting {unknown[0]!r:.60}; expected some of {', '.join(known)}")
    if "optimizer" in settings and not isinstance(settings["optimizer"], str):
        settings |= {"optimizer": "adam", "rule": settings["optimizer"]}
    log = as_log(log)
    parts = split_log(log, test, seed=seed)
    until = math.inf if seconds is None else deadline(seconds)
    fit = way(**{"model": model, **settings}).fit(log, parts, Context(seed, until, say))
    if uncertainty:
        fit = with_uncertainty(fit, parts, log.torque, say)
    return dataclasses.replace(fit, report=evaluate_fit(fit, parts, log, say=say))


def identify(
    robot: Robot | str | Path,
    log: Log | Trajectories | str | Path,
    *,
    test: str | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> Fit:
    """Identifies the bodies and the friction of a robot from a log, and evaluates them on held-out motions.

        fit = dln_jax.identify("arm.urdf", dln_jax.read_log("mine.csv", robot="arm.urdf"))

    The command `identify` also fits motions, coupled motors and temperature, and writes the robot's file.

    Args:
        robot: the robot, or its URDF or MJCF file.
        log: from `read_log`; or trajectories, or a file, whose joints are matched by name.
        test: test trajectories, as for `data.log.split_log`.
        say: takes lines on the progress.

    Raises:
        InputError: JAX without float64, or a log that does not belong to the robot.
    """
    from dln_jax.learning.fits.automatic import identify_robot
    from dln_jax.runs.evaluation import evaluate as evaluate_fit

    require_double_precision("identify")
    robot = robot if isinstance(robot, Robot) else read_robot(Path(robot))
    log = as_log(log, robot=robot)
    if log.needs.joints != robot.tree.joints:
        raise InputError(f"{log.name} has other joints than the robot; read it by read_log(..., robot=...)")
    log = log._replace(robot=log.robot or robot)
    parts = split_log(log, test)
    fit = with_uncertainty(identify_robot(log, parts), parts, log.torque, say)
    return dataclasses.replace(fit, report=evaluate_fit(fit, parts, log, say=say))


def evaluate(run: Run | str | Path, log: Log | Trajectories | str | Path) -> "Report":
    """Evaluates a stored or fitted model on another log, all of which is the test.

    Raises:
        InputError: the model has no dynamics, or other joints than the log.
    """
    from dln_jax.runs.evaluation import evaluate as evaluate_fit

    run = load(run) if isinstance(run, str | Path) else run
    needs, log = needs_from_json(run.description["needs"]), as_log(log)
    if needs.joints != log.needs.joints:
        raise InputError(
            f"the model has the joints {'-'.join(needs.joints)}, {log.name} has {'-'.join(log.needs.joints)}; "
            "give a log of the same plant"
        )
    empty = select_samples(log.data, slice(0))
    fields = {field.name: getattr(run, field.name) for field in dataclasses.fields(Run)}
    fit = run if isinstance(run, Fit) else Fit(**fields, needs=needs)
    return evaluate_fit(fit, Parts(Split(log.data, empty, log.data)), log)


def as_log(log: Log | Trajectories | str | Path, robot: Robot | None = None) -> Log:
    """The log of a file or of trajectories; a log itself."""
    if isinstance(log, Log):
        return log
    return log_of(log, "the data", robot=robot) if isinstance(log, Trajectories) else read_log(log, robot=robot)
