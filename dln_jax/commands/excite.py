"""Design motions that identify a robot, within its limits.

Each motion is a Fourier series that starts and ends at rest and can be repeated. Gradients improve the best of several
random series. Several motions are for identification, each optimised to complement those before it, and one is for
validation. Torques are predicted from the file's inertias and friction and from a payload. The run folder gets
excitation.npz (the schema of trajectories), a CSV file for each motion (t, q, qd), motions.json (the series),
excitation.png, metrics.json and config.json. Limits come from the file unless options state them. Options that take
lists expect one number for each joint.
"""

from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from dln_jax.errors import InputError
from dln_jax.options import Drawn, Folder, Unstated
from dln_jax.runs.arguments import names_listed, numbers_of


@dataclass(frozen=True, kw_only=True)
class Arguments(Folder, Drawn):
    """Robot, motions and limits."""

    robot: Path
    """URDF or MJCF file; its meshes may be missing."""
    seconds: float = 20.0
    """Length of each motion and period of its series, s."""
    harmonics: int = 5
    """Harmonics of the series; the highest frequency is harmonics / seconds, Hz."""
    rate: float = 100.0
    """Sampling rate of the written motions, Hz."""
    trajectories: int = 3
    """Number of motions for identification; one more is for validation."""
    starts: int = 4
    """Number of random starting motions for each optimised motion."""
    friction: bool = True
    """Include viscous and dry friction and an offset of each joint in the parameters."""
    velocity_scale: float = 0.05
    """Velocity at which dry friction has 76 % of its force, rad/s or m/s."""
    share: float = 0.9
    """Fraction of every limit to use; the rest is left to the controller."""
    position: Unstated[str] = None
    """Half the range of positions about zero, rad or m (default: the file's)."""
    velocity: Unstated[str] = None
    """Velocity limits, rad/s or m/s (default: those of a URDF)."""
    acceleration: Unstated[str] = None
    """Acceleration limits, rad/s² or m/s² (default: full velocity in 0.2 s)."""
    torque: Unstated[str] = None
    """Torque limits, N m or N (default: the file's)."""
    allow_unlimited: Unstated[str] = None
    """Comma-separated joints that may lack limits of position and torque; "*wheel*" matches all names that contain
    wheel. Positions are then limited to pi on either side (default: such joints are refused)."""
    noise: str = "1"
    """Standard deviation of the torque noise; only the ratios of the joints matter."""
    height: Unstated[float] = None
    """Height of a plane, m; the origins of all moving links stay above it (default: no plane)."""
    payload: Unstated[float] = None
    """Mass fixed to the last link, kg (default: 0)."""
    payload_position: str = "0,0,0"
    """Centre of the payload in the frame of the last joint, m."""
    seed: int = 0
    """Seed of the starts."""


def main(options: Arguments) -> None:
    """Designs the motions, writes them and prints a summary."""
    import jax
    import numpy as np

    from dln_jax.data import schema
    from dln_jax.data.csv_tables import write_motion
    from dln_jax.data.robots import read_robot
    from dln_jax.errors import require_memory
    from dln_jax.figures.torques import excitation_figure
    from dln_jax.files import write_json
    from dln_jax.identification.excitation.design import (
        as_trajectories,
        design_set,
        error_ratio,
        random_designs,
        together,
    )
    from dln_jax.identification.excitation.limits import heights_above, limits_of_robot, scale_limits
    from dln_jax.identification.excitation.task import make_task, require_sampling
    from dln_jax.mechanics.trees.description import with_payload
    from dln_jax.mechanics.trees.inertia import inertial_parameters
    from dln_jax.models.trees import make_rigid_tree
    from dln_jax.runs.folder import command_folder
    from dln_jax.runs.progress import progress
    from dln_jax.runs.report import Report, finish, png
    from dln_jax.types import require_positive

    count = options.trajectories
    require_positive(trajectories=count, starts=options.starts)
    require_sampling(period=options.seconds, harmonics=options.harmonics, rate=options.rate)
    robot = read_robot(options.robot)
    tree, d = robot.tree, robot.tree.degrees_of_freedom
    samples = options.seconds * options.rate * (count + 1)
    # Positions, rates and torques in the copies that are written and drawn.
    require_memory(f"{samples:.3g} samples (--seconds, --rate and --trajectories)", 100.0 * d * samples)
    if options.payload is not None:
        require_positive(payload=options.payload)
        centre = numbers_of("--payload-position", options.payload_position, [3])
        tree = with_payload(tree, d - 1, inertial_parameters(options.payload, centre, np.zeros((3, 3))))
    elif options.payload_position != "0,0,0":
        raise InputError("--payload-position needs the mass of a --payload; add it, or leave the position out")
    stated = {
        name: numbers_of(f"--{name}", text, [1, d], positive=True)
        for name in ("position", "velocity", "acceleration", "torque")
        if (text := getattr(options, name)) is not None
    }
    free = names_listed(options.allow_unlimited)
    limits, assumed = limits_of_robot(robot, force=stated.pop("torque", None), **stated, allow_unlimited=free)
    for line in assumed:
        print(f"warning: {line}")
    limits = scale_limits(limits, options.share)
    model = make_rigid_tree(tree, friction=options.friction, velocity_scale=options.velocity_scale)
    parameters: Any = model.init(jax.random.key(0))
    if options.friction:
        parameters = parameters._replace(viscous=robot.damping, coulomb=robot.coulomb)
    task = make_task(
        model,
        parameters,
        limits,
        period=options.seconds,
        harmonics=options.harmonics,
        clearance=None if options.height is None else heights_above(tree, options.height),
        noise=numbers_of("--noise", options.noise, [1, d], positive=True),
        seed=options.seed,
    )
    names = tree.names or tuple(f"joint_{k}" for k in range(d))
    labels = [*(f"train-{place + 1}" for place in range(count)), "validation"]
    with command_folder(options, "excite") as folder:
        drawn = random_designs(task, (count + 1) * options.starts, seed=options.seed)
        with progress(count + 1, "motions") as show:
            train, validation = design_set(task, drawn, trajectories=count, say=show)
        designs = [*train, validation]

        needs = tree.needs._replace(friction=bool(robot.damping.any()))
        data = as_trajectories(designs, labels, model, parameters, rate=options.rate, needs=needs)
        data = data._replace(joint_names=np.array(names))
        schema.save(folder / "excitation.npz", data)
        for index, label in enumerate(labels):
            rows = data.trajectory == index
            columns = (data.t[rows], data.q[rows], data.qd[rows])
            write_motion(folder / f"{label}.csv", *columns, names=names, joints=tree.joints)
        series = {}
        for label, (motion, *_) in zip(labels, designs, strict=True):
            sines, cosines = np.split(np.asarray(motion.coefficients), 2, axis=1)
            series[label] = {
                "period": motion.period,
                "offset": np.asarray(motion.offset).tolist(),
                "sines": sines.tolist(),
                "cosines": cosines.tolist(),
            }
        write_json(folder / "motions.json", {"joints": list(names), "motions": series})

        # A random set combines as many motions as the training set.
        groups = [drawn[place : place + count] for place in range(0, len(drawn) - count + 1, count)]
        of_groups = np.median([together(group) for group in groups], axis=0)
        ratios = [error_ratio(train, group) for group in groups]
        random, designed = ([design.condition for design in motions] for motions in (drawn, designs))
        condition, determinant = together(train)
        metrics = {
            "base_parameters": task.columns.size,
            "random_condition_median": median(random),
            "random_condition_best": min(random),
            "train_condition_worst": max(designed[:-1]),
            "validation_condition": validation.condition,
            "random_set_condition_median": float(of_groups[0]),
            "train_set_condition": condition,
            "random_log_determinant_median": median(design.log_determinant for design in drawn),
            "train_set_log_determinant": determinant,
            "standard_error_ratio_median": median(ratios),
            "standard_error_ratio_worst": max(ratios),
            "least_slack": min(design.slack for design in designs),
        }

        rows = [
            ("random, median", metrics["random_condition_median"], metrics["random_log_determinant_median"], ""),
            *(
                (label, design.condition, design.log_determinant, design.nearest)
                for label, design in zip(labels, designs, strict=True)
            ),
            (f"random, {count} together, median", *of_groups, ""),
            (f"train, {count} together", condition, determinant, ""),
        ]
        table = [(name, f"{number:.3g}", f"{logarithm:.1f}", near) for name, number, logarithm, near in rows]
        shown = {"q": limits.position, "qd": np.stack([-limits.velocity, limits.velocity], 1), "tau": limits.force}

        figure = png(excitation_figure, data, shown, names=names, conditions={"random": random, "designed": designed})
        size, ratio = task.columns.size, metrics["standard_error_ratio_median"]
        line = f"standard errors of {size} base parameters over those after random motions: {ratio:.2f} (median)"
        columns = ("motion", "condition", "log det", "nearest limit")
        finish(folder, options, Report(metrics, table, "", columns, lines=(line,), figures={"excitation.png": figure}))
