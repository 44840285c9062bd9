"""Designs motions that show a robot's parameters, and writes them into a run folder."""

from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from dln_jax.data import schema
from dln_jax.data.csv_tables import write_motion
from dln_jax.data.robots import Robot, read_robot
from dln_jax.figures.torques import excitation_figure
from dln_jax.files import write_figure, write_json
from dln_jax.identification.excitation.candidates import Design, random_designs
from dln_jax.identification.excitation.design import CRITERIA, as_trajectories, design_set, error_ratio, together
from dln_jax.identification.excitation.fourier import require_sampling
from dln_jax.identification.excitation.limits import MotionLimits, heights_above, limits_of_robot, used
from dln_jax.identification.excitation.task import Task, make_task
from dln_jax.mechanics.trees.description import with_payload
from dln_jax.mechanics.trees.inertia import inertial_parameters
from dln_jax.models.model import Model, Parameters
from dln_jax.models.trees import make_rigid_tree
from dln_jax.runs.arguments import numbers_of
from dln_jax.runs.progress import progress
from dln_jax.runs.report import print_numbers
from dln_jax.runs.stored_arguments import command_folder
from dln_jax.sizes import require_memory
from dln_jax.types import InputError, require_positive

VALIDATION = "validation"


class Prepared(NamedTuple):
    """Robot, limits, model and task that follow from the arguments."""

    robot: Robot
    names: tuple[str, ...]
    limits: MotionLimits
    model: Model
    parameters: Parameters
    task: Task


def excite(options: Any) -> None:
    """Designs the motions, writes them and prints a summary."""
    require_positive(trajectories=options.trajectories, starts=options.starts)
    prepared = prepare(options)
    with command_folder(options, "excite") as folder:
        drawn = random_designs(prepared.task, (options.trajectories + 1) * options.starts, seed=options.seed)
        with progress(options.trajectories + 1, "motions") as show:
            train, validation = design_set(
                prepared.task, drawn, trajectories=options.trajectories, criterion=options.criterion, say=show
            )
        metrics = numbers(prepared.task, drawn, train, validation)
        write(folder, options, prepared, [*train, validation])
        write_json(folder / "metrics.json", metrics)
        if options.figures:
            draw(folder, prepared, drawn, [*train, validation])
        summarise(drawn, train, validation, metrics)
        print(f"run folder: {folder}")


def prepare(options: Any) -> Prepared:
    """Reads the robot, builds the task, and prints the limits that had to be assumed."""
    if options.criterion not in CRITERIA:
        raise InputError(f"--criterion is '{options.criterion:.60}'; expected one of {', '.join(CRITERIA)}")
    require_sampling(period=options.seconds, harmonics=options.harmonics, rate=options.rate)
    robot = read_robot(options.robot)
    d = robot.tree.degrees_of_freedom
    samples = options.seconds * options.rate * (options.trajectories + 1)
    # Positions, rates and torques in the copies that are written and drawn.
    require_memory(f"{samples:.3g} samples (--seconds, --rate and --trajectories)", 100.0 * d * samples)
    if options.payload is not None:
        require_positive(payload=options.payload)
        centre = numbers_of("--payload-position", options.payload_position, [3])
        carried = inertial_parameters(options.payload, centre, np.zeros((3, 3)))
        robot = robot._replace(tree=with_payload(robot.tree, d - 1, carried))
    elif options.payload_position != "0,0,0":
        raise InputError("--payload-position is for a --payload, which is not given; add its mass, or leave it out")
    names = ("position", "velocity", "acceleration", "torque")
    texts = {name: text for name in names if (text := getattr(options, name)) is not None}
    stated = {name: numbers_of(f"--{name}", text, [1, d], positive=True) for name, text in texts.items()}
    free = [name.strip() for name in (options.allow_unlimited or "").split(",")]
    limits, assumed = limits_of_robot(
        robot, force=stated.pop("torque", None), **stated, allow_unlimited=[name for name in free if name]
    )
    for line in assumed:
        print(f"warning: {line}")
    limits = used(limits, options.share)
    model = make_rigid_tree(robot.tree, friction=options.friction, velocity_scale=options.velocity_scale)
    parameters: Any = model.init(jax.random.key(0))
    if options.friction:
        parameters = parameters._replace(viscous=robot.damping, coulomb=robot.coulomb)
    task = make_task(
        model,
        parameters,
        limits,
        period=options.seconds,
        harmonics=options.harmonics,
        clearance=None if options.height is None else heights_above(robot.tree, options.height),
        noise=numbers_of("--noise", options.noise, [1, d], positive=True),
        seed=options.seed,
    )
    names = robot.tree.names or tuple(f"joint_{k}" for k in range(d))
    return Prepared(robot, names, limits, model, parameters, task)


def labels(designs: list[Design]) -> list[str]:
    """Names of the motions; the last one is for validation."""
    return [*(f"train-{place + 1}" for place in range(len(designs) - 1)), VALIDATION]


def numbers(task: Task, drawn: list[Design], train: list[Design], validation: Design) -> dict[str, float]:
    """Metrics of the random and the designed motions; a random set combines as many motions as the training set."""
    groups = [drawn[place : place + len(train)] for place in range(0, len(drawn) - len(train) + 1, len(train))]
    ratios = [error_ratio(train, group) for group in groups]
    return {
        "base_parameters": float(task.columns.size),
        "random_condition_median": float(np.median([design.condition for design in drawn])),
        "random_condition_best": min(design.condition for design in drawn),
        "train_condition_worst": max(design.condition for design in train),
        "validation_condition": validation.condition,
        "random_set_condition_median": float(np.median([together(group)[0] for group in groups])),
        "train_set_condition": together(train)[0],
        "random_log_determinant_median": float(np.median([design.log_determinant for design in drawn])),
        "train_set_log_determinant": together(train)[1],
        "standard_error_ratio_median": float(np.median(ratios)),
        "standard_error_ratio_worst": float(np.max(ratios)),
        "least_slack": min(design.slack for design in (*train, validation)),
    }


def write(folder: Path, options: Any, prepared: Prepared, designs: list[Design]) -> None:
    """Writes the motions as a dataset, as CSV tables and as Fourier series."""
    data = _data(options.rate, prepared, designs)
    schema.save(folder / "excitation.npz", data)
    for index, label in enumerate(data.label):
        rows = data.trajectory == index
        columns = (data.t[rows], data.q[rows], data.qd[rows])
        write_motion(folder / f"{label}.csv", *columns, names=prepared.names, joints=prepared.robot.tree.joints)
    series = {
        label: {
            "period": design.motion.period,
            "offset": np.asarray(design.motion.offset).tolist(),
            "sines": np.asarray(design.motion.coefficients)[:, : options.harmonics].tolist(),
            "cosines": np.asarray(design.motion.coefficients)[:, options.harmonics :].tolist(),
        }
        for label, design in zip(labels(designs), designs, strict=True)
    }
    write_json(folder / "motions.json", {"joints": list(prepared.names), "motions": series})


def _data(rate: float, prepared: Prepared, designs: list[Design]) -> schema.Trajectories:
    needs = prepared.robot.tree.needs._replace(friction=bool(prepared.robot.damping.any()))
    data = as_trajectories(designs, labels(designs), prepared.model, prepared.parameters, rate=rate, needs=needs)
    return data._replace(joint_names=np.array(prepared.names))


def draw(folder: Path, prepared: Prepared, drawn: list[Design], designs: list[Design]) -> None:
    """Draws the motions, their limits and their condition numbers."""
    limits = prepared.limits
    shown = {"q": limits.position, "qd": np.stack([-limits.velocity, limits.velocity], 1), "tau": limits.force}
    conditions = {
        "random": [design.condition for design in drawn],
        "designed": [design.condition for design in designs],
    }
    # The figure is some thousand points wide: a higher rate would not show.
    data = _data(max(400 / prepared.task.period, 3 * prepared.task.harmonics / prepared.task.period), prepared, designs)
    write_figure(folder / "excitation.png", excitation_figure(data, shown, names=prepared.names, conditions=conditions))


def summarise(drawn: list[Design], train: list[Design], validation: Design, metrics: dict[str, float]) -> None:
    """Prints the table of condition numbers and the gain in standard error."""
    count = metrics["base_parameters"]
    rows = [
        (name, f"{condition:.3g}", f"{logarithm:.1f}", near)
        for name, condition, logarithm, near in (
            ("random, median", metrics["random_condition_median"], metrics["random_log_determinant_median"], ""),
            *(
                (name, design.condition, design.log_determinant, design.nearest)
                for name, design in zip(labels([*train, validation]), (*train, validation), strict=True)
            ),
            (f"random, {len(train)} together", metrics["random_set_condition_median"], np.nan, ""),
            (f"train, {len(train)} together", *together(train), ""),
        )
    ]
    print_numbers(rows, columns=("motion", "condition", "log det", "nearest limit"))
    ratio = metrics["standard_error_ratio_median"]
    print(f"standard errors of {count:.0f} base parameters: {ratio:.2f} of those after random motions, on average")
