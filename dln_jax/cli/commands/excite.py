"""Design motions that show a robot's parameters: Fourier series within its limits, the best by gradients.

Each motion starts and ends at rest and may be repeated. Several to identify from, each the best beside those before it,
and one to validate on; predicted torques are those of the file's inertias and friction, and of a payload. Writes a run
folder: excitation.npz (the schema of trajectories), a CSV file for each motion (t, q, qd), motions.json (the series),
excitation.png, metrics.json and config.json. Limits are those of the file; options take their place. A list of numbers
has one for each joint.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import numpy as np

from dln_jax.cli.arguments import Unstated, choice, numbers_of
from dln_jax.cli.options import Drawn, Folder
from dln_jax.cli.progress import progress
from dln_jax.cli.running import command_folder
from dln_jax.data import schema
from dln_jax.data.motion_tables import write_motion
from dln_jax.data.robots import Robot, read_robot
from dln_jax.figures.joints import excitation_figure
from dln_jax.files import write_figure, write_json
from dln_jax.identification.excitation.candidates import Design, random_designs
from dln_jax.identification.excitation.design import CRITERIA, as_trajectories, design_set, error_ratio, together
from dln_jax.identification.excitation.fourier import require_sampling
from dln_jax.identification.excitation.limits import MotionLimits, heights_above, limits_of_robot, used
from dln_jax.identification.excitation.task import Task, make_task
from dln_jax.mechanics.trees import inertial_parameters, with_payload
from dln_jax.models.model import Model, Parameters
from dln_jax.models.rigid_tree import make_rigid_tree
from dln_jax.sizes import require_memory
from dln_jax.training.results import print_numbers
from dln_jax.types import InputError, require_positive

VALIDATION = "validation"


@dataclass(frozen=True, kw_only=True)
class Arguments(Folder, Drawn):
    """Robot, motions and limits."""

    robot: Path
    """URDF or MJCF file; meshes need not be there."""
    seconds: float = 20.0
    """Length of each motion, its period, s."""
    harmonics: int = 5
    """Of the series: the highest frequency is harmonics / seconds, Hz."""
    rate: float = 100.0
    """Samples written, Hz."""
    trajectories: int = 3
    """Motions to identify from; one more is to validate on."""
    starts: int = 4
    """Random motions from which each is optimised."""
    criterion: Annotated[str, choice(CRITERIA)] = "information"
    """information: parameters' errors in product are least; condition: that of the regressor is."""
    friction: bool = True
    """Viscous and dry friction and an offset of each joint are parameters too."""
    velocity_scale: float = 0.05
    """Velocity at which dry friction has 76 % of its force, 1/s or m/s; what is slower hardly counts."""
    share: float = 0.9
    """Of every limit that is used: the rest is for the controller."""
    position: Unstated[str] = None
    """Half the range of positions about zero, rad or m (default: the file's)."""
    velocity: Unstated[str] = None
    """Limits, rad/s or m/s (default: those of a URDF)."""
    acceleration: Unstated[str] = None
    """Limits, rad/s² or m/s² (default: full velocity in 0.2 s)."""
    torque: Unstated[str] = None
    """Limits, N m or N (default: the file's)."""
    allow_unlimited: Unstated[str] = None
    """Joints that may lack limits of position and torque, comma separated; "*wheel*" names all with wheel in their
    name. Positions then go pi to either side. (default: such joints are refused)"""
    noise: str = "1"
    """Deviation of the torque's noise, of which only the ratios of joints matter."""
    height: Unstated[float] = None
    """Of a plane, m, above which the origin of every link that moves stays (default: no plane)."""
    payload: Unstated[float] = None
    """Mass fixed to the last link, kg (default: 0)."""
    payload_position: str = "0,0,0"
    """Of its centre in the frame of the last joint, m."""
    seed: int = 0
    """Of the starts."""


class Prepared(NamedTuple):
    """Robot, limits, model and task that follow from the arguments."""

    robot: Robot
    names: tuple[str, ...]
    limits: MotionLimits
    model: Model
    parameters: Parameters
    task: Task


def main(given: Arguments) -> None:
    """Designs the motions, writes them and prints a summary."""
    require_positive(trajectories=given.trajectories, starts=given.starts)
    prepared = prepare(given)
    with command_folder(given, "excite") as folder:
        drawn = random_designs(prepared.task, (given.trajectories + 1) * given.starts, seed=given.seed)
        with progress(given.trajectories + 1, "motions") as show:
            train, validation = design_set(
                prepared.task, drawn, trajectories=given.trajectories, criterion=given.criterion, say=show
            )
        metrics = numbers(prepared.task, drawn, train, validation)
        write(folder, given, prepared, [*train, validation])
        write_json(folder / "metrics.json", metrics)
        if given.figures:
            draw(folder, prepared, drawn, [*train, validation])
        say(drawn, train, validation, metrics)
        print(f"run folder: {folder}")


def prepare(given: Arguments) -> Prepared:
    """Reads the robot, builds the task, and prints the limits that had to be assumed."""
    if given.criterion not in CRITERIA:
        raise InputError(f"--criterion is '{given.criterion:.60}'; expected one of {', '.join(CRITERIA)}")
    require_sampling(period=given.seconds, harmonics=given.harmonics, rate=given.rate)
    robot = read_robot(given.robot)
    d = robot.tree.degrees_of_freedom
    samples = given.seconds * given.rate * (given.trajectories + 1)
    # Positions, rates and torques in the copies that are written and drawn.
    require_memory(f"{samples:.3g} samples (--seconds, --rate and --trajectories)", 100.0 * d * samples)
    if given.payload is not None:
        require_positive(payload=given.payload)
        centre = numbers_of("--payload-position", given.payload_position, [3])
        carried = inertial_parameters(given.payload, centre, np.zeros((3, 3)))
        robot = robot._replace(tree=with_payload(robot.tree, d - 1, carried))
    elif given.payload_position != Arguments.payload_position:
        raise InputError("--payload-position is for a --payload, which is not given; add its mass, or leave it out")
    names = ("position", "velocity", "acceleration", "torque")
    texts = {name: text for name in names if (text := getattr(given, name)) is not None}
    stated = {name: numbers_of(f"--{name}", text, [1, d], positive=True) for name, text in texts.items()}
    free = [name.strip() for name in (given.allow_unlimited or "").split(",")]
    limits, assumed = limits_of_robot(
        robot, force=stated.pop("torque", None), **stated, allow_unlimited=[name for name in free if name]
    )
    for line in assumed:
        print(f"warning: {line}")
    limits = used(limits, given.share)
    model = make_rigid_tree(robot.tree, friction=given.friction, velocity_scale=given.velocity_scale)
    parameters: Any = model.init(jax.random.key(0))
    if given.friction:
        parameters = parameters._replace(viscous=robot.damping, coulomb=robot.coulomb)
    task = make_task(
        model,
        parameters,
        limits,
        period=given.seconds,
        harmonics=given.harmonics,
        clearance=None if given.height is None else heights_above(robot.tree, given.height),
        noise=numbers_of("--noise", given.noise, [1, d], positive=True),
        seed=given.seed,
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
        "random_condition_median": float(np.median([each.condition for each in drawn])),
        "random_condition_best": min(each.condition for each in drawn),
        "train_condition_worst": max(each.condition for each in train),
        "validation_condition": validation.condition,
        "random_set_condition_median": float(np.median([together(group)[0] for group in groups])),
        "train_set_condition": together(train)[0],
        "random_log_determinant_median": float(np.median([each.log_determinant for each in drawn])),
        "train_set_log_determinant": together(train)[1],
        "standard_error_ratio_median": float(np.median(ratios)),
        "standard_error_ratio_worst": float(np.max(ratios)),
        "least_slack": min(each.slack for each in (*train, validation)),
    }


def write(folder: Path, given: Arguments, prepared: Prepared, designs: list[Design]) -> None:
    """Writes the motions as a dataset, as CSV tables and as Fourier series."""
    data = _data(given.rate, prepared, designs)
    schema.save(folder / "excitation.npz", data)
    for index, label in enumerate(data.label):
        rows = data.trajectory == index
        columns = (data.t[rows], data.q[rows], data.qd[rows])
        write_motion(folder / f"{label}.csv", *columns, names=prepared.names, joints=prepared.robot.tree.joints)
    series = {
        label: {
            "period": design.motion.period,
            "offset": np.asarray(design.motion.offset).tolist(),
            "sines": np.asarray(design.motion.coefficients)[:, : given.harmonics].tolist(),
            "cosines": np.asarray(design.motion.coefficients)[:, given.harmonics :].tolist(),
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
    conditions = {"random": [each.condition for each in drawn], "designed": [each.condition for each in designs]}
    # The figure is some thousand points wide: a higher rate would not show.
    data = _data(max(400 / prepared.task.period, 3 * prepared.task.harmonics / prepared.task.period), prepared, designs)
    write_figure(folder / "excitation.png", excitation_figure(data, shown, names=prepared.names, conditions=conditions))


def say(drawn: list[Design], train: list[Design], validation: Design, metrics: dict[str, float]) -> None:
    """Prints the table of condition numbers and the gain in standard error."""
    count = metrics["base_parameters"]
    rows = [
        (name, f"{condition:.3g}", f"{logarithm:.1f}", near)
        for name, condition, logarithm, near in (
            ("random, median", metrics["random_condition_median"], metrics["random_log_determinant_median"], ""),
            *(
                (name, each.condition, each.log_determinant, each.nearest)
                for name, each in zip(labels([*train, validation]), (*train, validation), strict=True)
            ),
            (f"random, {len(train)} together", metrics["random_set_condition_median"], np.nan, ""),
            (f"train, {len(train)} together", *together(train), ""),
        )
    ]
    print_numbers(rows, columns=("motion", "condition", "log det", "nearest limit"))
    ratio = metrics["standard_error_ratio_median"]
    print(f"standard errors of {count:.0f} base parameters: {ratio:.2f} of those after random motions, on average")
