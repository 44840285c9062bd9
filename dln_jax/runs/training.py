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
    """Fits a model of dynamics to a log and evaluates it on held-out motions.

    The fit minimises the squared torque error of tau = M(q) qdd + c(q, qd) + g(q) + friction, each joint in units of
    its torque's standard deviation. `fit.report` has metrics and verdict, and `fit.save(folder)` stores the model.

    Args:
        log: from `read_log`; or trajectories, or a file.
        model: "auto" for model selection, or a name in `learning.fits.settings.WAYS`.
        test: test trajectories, as for `data.log.split_log`.
        seed: seed for parameters, shuffling and the validation split.
        seconds: time limit of the fit, s.
        uncertainty: estimate the standard deviation of the torques.
        say: takes lines of progress; pass `print` to show them.
        settings: fields of the model's class in `learning.fits.settings`, such as `width`. The `optimizer` of a network
            may be any optimiser of optax: `optimizer=optax.adam(3e-4), steps=5000`.

    Returns:
        The fitted model, its functions as in a loaded run, the training history and the report.

    Raises:
        InputError: JAX without float64, an unknown model or setting, or data that do not suit the model.

    Example:
        >>> import jax
        >>> import dln_jax
        >>> from dln_jax.scenes.datasets.generators import uniform
        >>> from dln_jax.scenes.pendulums import pendulum
        >>> jax.config.update("jax_enable_x64", True)
        >>> fit = dln_jax.train(uniform(pendulum(), samples=200), "trigonometric", degree=1, uncertainty=False)
        >>> print(fit.report.verdict.level, fit.dynamics.inverse_dynamics([0.0], [0.0], [2.0]).round(4))  # N m
        good [2.]
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
    """Identifies inertias and friction of a robot from a log, and evaluates the result on held-out motions.

    The torques are linear in the inertial and friction parameters, tau = Phi(q, qd, qdd) theta (Atkeson, An and
    Hollerbach 1986), so the fit is a weighted least-squares problem. The command `identify` also fits motions, coupled
    motors and temperature, and writes a robot file.

    Args:
        robot: the robot, or its URDF or MJCF file.
        log: from `read_log`; or trajectories, or a file. Joints are matched by name.
        test: test trajectories, as for `data.log.split_log`.
        say: takes lines of progress; pass `print` to show them.

    Returns:
        The fitted rigid tree, its functions as in a loaded run, and the report with metrics and verdict.

    Raises:
        InputError: JAX without float64, or a log with other joints than the robot.

    Example:
        >>> import pathlib
        >>> import tempfile
        >>> import jax
        >>> import numpy as np
        >>> import dln_jax
        >>> jax.config.update("jax_enable_x64", True)
        >>> t = np.linspace(0.0, 10.0, 201)
        >>> q = np.sin(t) + 0.3 * np.sin(3 * t)
        >>> tau = 3.0 * (-np.sin(t) - 2.7 * np.sin(3 * t)) - 29.43 * np.cos(q)  # 3 kg at 1 m; the file says 2 kg
        >>> link = '<joint name="hinge" axis="0 1 0"/><geom size="0.1" mass="2" pos="1 0 0"/>'
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = pathlib.Path(folder, "arm.xml")
        ...     _ = file.write_text(f"<mujoco><worldbody><body>{link}</body></worldbody></mujoco>")
        ...     np.savez(f"{folder}/log.npz", t=t, q=q[:, None], tau=tau[:, None])
        ...     fit = dln_jax.identify(file, dln_jax.load_trajectories(f"{folder}/log.npz"))
        >>> print(fit.report.verdict.level, fit.dynamics.mass_matrix([0.0]).round(1))  # kg m²
        good [[3.]]
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
    """Evaluates a stored or fitted model on all motions of another log.

    Args:
        run: a run, from `load`, `train` or `identify`, or its folder.
        log: from `read_log`; or trajectories, or a file.

    Returns:
        The report, with metrics (errors in SI units; `torque_mse` in (N m)² or N²) and a verdict.

    Raises:
        InputError: the model has no dynamics, or other joints than the log.

    Example:
        >>> import jax
        >>> import dln_jax
        >>> from dln_jax.scenes.datasets.generators import uniform
        >>> from dln_jax.scenes.pendulums import pendulum
        >>> jax.config.update("jax_enable_x64", True)
        >>> fit = dln_jax.train(uniform(pendulum(), samples=200), "trigonometric", degree=1, uncertainty=False)
        >>> report = dln_jax.evaluate(fit, uniform(pendulum(mass=2.0), samples=50, seed=1))
        >>> print(report.verdict.level, report.metrics["torque_mse"] > 1.0)  # the other pendulum is heavier
        refused True
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
    """Converts a file or trajectories to a log; a log is returned unchanged."""
    if isinstance(log, Log):
        return log
    return log_of(log, "the data", robot=robot) if isinstance(log, Trajectories) else read_log(log, robot=robot)
