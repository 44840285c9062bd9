"""Builds an identification task from options: the robot's file, its data, and the held-out part."""

from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.data import schema
from dln_jax.data.encoders.smoothing import labels_of_parts
from dln_jax.data.repeated_motions import motion_numbers, remark_on_repeats
from dln_jax.data.robots import Robot, read_robot
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import (
    BLOCKS,
    by_motion,
    every,
    in_blocks,
    is_cut,
    label_indices,
    require_no_copies,
    select,
    stated_test,
    with_joints,
)
from dln_jax.learning.friction import FrictionFit, fit_friction
from dln_jax.mechanics.friction.laws import FrictionShape, require_laws
from dln_jax.mechanics.trees.description import tree_to_json
from dln_jax.models.model import Parameters
from dln_jax.runs.arguments import names_in, names_listed, numbers_of, refuse_given, require_positive_if_given
from dln_jax.runs.encoders import fitted_torque, prepare_log, without_torque
from dln_jax.runs.logs import facts
from dln_jax.training.identification.motions import MotionSets, lightly_filtered
from dln_jax.training.identification.options import IDENTIFIED, NO_FRICTION, Options
from dln_jax.training.identification.terms import Wanted, at_reference, chosen, wanted
from dln_jax.types import FrictionLaw, InputError
from dln_jax.zoo.descriptions import Description, build, describe

SETTLED = ("split", "repeated-motions", "friction", "condition")
"""Checks of a log that the robot's file and this command make unnecessary."""
MOST_SAMPLES = 4_000
"""Largest number of samples used to fit the shapes of friction."""
HELD_OUT = slice(2, None, 5)
"""Trajectories or blocks held out: the third of every five."""


class Sets(NamedTuple):
    """Training and held-out data."""

    train: Trajectories
    test: Trajectories
    blocks: bool
    """Whether the parts are blocks of one trajectory."""


class Case(NamedTuple):
    """A robot and its data, ready for identification."""

    robot: Robot
    names: tuple[str, ...]
    sets: Sets
    description: Description
    model: Any
    known: Parameters
    """Parameters in the robot's file."""
    noise: np.ndarray | None
    """Noise of the torques, if stated."""
    locked: tuple[str, ...]
    lines: tuple[str, ...]
    """Lines for the user: the origin of the rates, and findings about the log."""
    torque: str = "measured torques"
    """The torques that the fit and its uncertainty bands refer to."""
    robot_file: str = ""
    data_file: str = ""
    filtered_noise: np.ndarray | None = None
    """Standard deviation of the noise of filtered torques [d]; `None` if they are not filtered."""
    motions: MotionSets | None = None
    """Motions to fit and to predict, with --by motions or both."""
    wanted: Wanted = Wanted()
    """Terms that cross-validation may add."""
    causes: tuple[str, ...] = ()
    """Faults that the check found in the log and that no filter repairs."""

    @property
    def laws(self) -> tuple[FrictionLaw, ...]:
        """Friction laws that are identified."""
        return tuple(self.description["needs"]["joint_friction"])


def prepare(options: Options) -> Case:
    """Reads and checks everything that the options name, before anything is written."""
    locked = names_listed(options.lock)
    robot = read_robot(options.robot, lock=locked)
    laws = () if options.friction == NO_FRICTION else tuple(names_in("--friction", options.friction, IDENTIFIED))
    require_laws(laws, "--friction")
    require_positive_if_given(options, ["velocity_scale"])
    try:
        data = with_joints(schema.load(options.data, **facts(options), robot=robot.tree.names), robot.tree.names)
    except InputError as error:
        raise InputError(str(error) if str(options.data) in str(error) else f"{options.data}: {error}") from None
    if "tau" in data.estimated:
        raise InputError(
            f"{options.data}: the data have no tau; identification takes measured torques{without_torque(data)}"
        )
    filtered, lines, causes, measured = prepare_log(options, data, options.data, robot=robot, without=SETTLED)
    robot = measured or robot
    require_positive_if_given(options, ["window"])
    light = None
    if options.by == "torques":
        refuse_given(options, ["window"], "for --by motions or both")
    else:
        light = lightly_filtered(data, filtered)
    if filtered is not None:
        data = filtered.data
    motion, motions = None if is_cut(options.test or None) else motion_numbers(data.q, data.trajectory), None
    sets = held_out(data, options.test or None, motion, in_parts=filtered is not None)
    remark = remark_on_repeats([sets.train], sets.test, None if sets.blocks else motion)
    lines = (*lines, *filter(None, [remark]))
    if light is not None:
        motions = MotionSets(*held_out(light, options.test or None, motion, in_parts=filtered is not None)[:2])
    terms = wanted(options, cast(tuple[FrictionLaw, ...], laws), data)
    needs = robot.tree.needs._replace(joint_friction=cast(tuple[FrictionLaw, ...], laws))
    scale = {} if options.velocity_scale is None else {"velocity_scale": options.velocity_scale}
    fixed = {"motors": terms.motors, "coupled": terms.coupled, **scale}
    description = describe("rigid-tree", precision="f64", needs=needs, tree=tree_to_json(robot.tree), **fixed)
    noise = noises(options.noise, robot.tree.degrees_of_freedom)
    torque = fitted_torque(filtered)
    case = Case(robot, robot.tree.names, sets, description, None, None, noise, locked, lines, torque)
    more: dict[str, Any] = {"causes": causes, "robot_file": options.robot.name, "data_file": options.data.name}
    if filtered is not None and filtered.filtered_torque:
        more["filtered_noise"] = filtered.noise_tau
    return with_description(case._replace(motions=motions, wanted=terms, **more))


def with_description(case: Case, **changes: Any) -> Case:
    """The case with changed keywords of its model, which is rebuilt."""
    description = {**case.description, **changes}
    model = build(description)
    known = model.init(jax.random.key(0))
    stated = {"viscous": case.robot.damping, "coulomb": case.robot.coulomb}
    known = known._replace(
        **{name: jnp.asarray(values) for name, values in stated.items() if getattr(known, name) is not None}
    )
    return case._replace(description=description, model=model, known=known)


def with_terms(velocity_scale: float | None, case: Case) -> tuple[Case, FrictionFit | None]:
    """Adds the terms that cross-validation keeps and fits shapes of friction; returns the case and that fit, if any.

    The velocity scale is fitted unless it is stated.
    """
    held = () if velocity_scale is None else ("velocity_scale",)
    start = FrictionShape(**({} if velocity_scale is None else {"velocity_scale": velocity_scale}))
    tree, train = case.robot.tree, case.sets.train
    terms, lines = chosen(case.wanted, tree, train, case.laws, start, held)
    case = case._replace(lines=tuple(lines))
    needs = {**case.description["needs"], "joint_friction": list(terms.laws)}
    changes: dict[str, Any] = {"needs": needs, "coupled": [list(pair) for pair in terms.coupled]}
    if not terms.learned:
        return with_description(case, **changes), None
    fitted = fit_friction(
        tree, every(train, -(-len(train.t) // MOST_SAMPLES)), terms.laws, shape=start, held=held, noise=case.noise,
        cooling="cooling" in terms.learned, motors=terms.motors, coupled=terms.coupled,
    )  # fmt: skip
    changes |= {name: values.tolist() for name, values in fitted.shape.items()}
    if fitted.reference_temperature is not None:
        changes["reference_temperature"] = fitted.reference_temperature
    return with_description(case, **changes), fitted


def referred(case: Case, parameters: Parameters) -> Case:
    """The case with torques at the reference temperature, by the friction of these parameters."""
    if not np.any(case.description["cooling"]):
        return case
    convert = at_reference(case.model, parameters, case.description["reference_temperature"])
    sets = case.sets._replace(train=convert(case.sets.train), test=convert(case.sets.test))
    return case._replace(sets=sets, motions=None if case.motions is None else MotionSets(*map(convert, case.motions)))


def for_residual(train: Trajectories) -> tuple[Trajectories, Trajectories]:
    """Training data of a residual network, and every fourth trajectory or block as validation for its size."""
    present = np.unique(train.trajectory)
    chosen = present[1::4]
    if not len(chosen):
        raise InputError("--residual takes two trajectories or blocks to fit at least; record more motions")
    return select(train, np.setdiff1d(present, chosen)), select(train, chosen)


def held_out(data: Trajectories, test: str | None, motion: np.ndarray | None = None, *, in_parts: bool) -> Sets:
    """Training and held-out data as --test states them; `in_parts` if a filter cut trajectories at gaps.

    `motion` as for `data.splits.split`: blocks and last parts of recordings of one motion need not stay together.
    """
    if is_cut(test):
        return split(*stated_test(data, test))
    labels = stated_test(data, test)[1]
    return split(data, labels_of_parts(data, labels) if in_parts and labels else labels, motion)


def split(data: Trajectories, test: list[str] | None, motion: np.ndarray | None = None) -> Sets:
    """Training and held-out trajectories, or blocks of time if there is only one trajectory."""
    if len(np.unique(data.trajectory)) == 1:
        if test is not None:
            raise InputError("--test names trajectories, and the data have one only; give last:30%, or leave it out")
        return split(in_blocks(data, BLOCKS), None)._replace(blocks=True)
    present = np.unique(data.trajectory)
    held = by_motion(present, motion, HELD_OUT, least=2)
    if test is not None:
        held = label_indices(data, test)
    rest = np.setdiff1d(present, held)
    if not len(rest) or not len(np.intersect1d(held, present)):
        raise InputError("--test leaves no trajectory to fit, or none to judge by; name fewer, or others")
    sets = Sets(select(data, rest), select(data, held), blocks=False)
    require_no_copies(sets.train, sets.test)
    return sets


def noises(stated: str | None, d: int) -> np.ndarray | None:
    """Parses --noise."""
    if stated is None:
        return None
    return np.array(numbers_of("--noise", stated, [d], positive=True))
