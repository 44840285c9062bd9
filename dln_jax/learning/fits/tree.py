"""Trees of unknown joint frames: a search from random starts finds the frames, elimination everything else."""

from dln_jax.data.log import Log
from dln_jax.data.parts import Parts
from dln_jax.files import read_json
from dln_jax.learning.engine.checkpoint import Context
from dln_jax.learning.fit import Fit, direct_fit
from dln_jax.learning.fits.direct import described, goal_of, refine
from dln_jax.learning.fits.settings import Arm, LearnedTree
from dln_jax.learning.kinematics.fit import fit_tree
from dln_jax.learning.kinematics.frames import KinematicPrior, kinematic_prior_from_json
from dln_jax.learning.kinematics.search import Search
from dln_jax.mechanics.friction.laws import USUAL
from dln_jax.types import InputError, Needs


def fit(settings: LearnedTree, log: Log, parts: Parts, context: Context) -> Fit:
    """Searches joint frames by Gauss-Newton, from random starts or near a prior, and eliminates everything else."""
    needs = needs_of_tree(log.needs)
    parents = parents_of(settings, needs.degrees_of_freedom)
    prior = kinematic_prior_of(settings, needs.degrees_of_freedom, parents)
    description = described(settings, needs, parts, context, parents=parents, velocity_scale=needs.velocity_scale)
    solution = fit_tree(
        needs,
        parts.sets.train,
        parts.sets.validation,
        parents=description["parents"],
        acceleration=description["acceleration"],
        velocity_scale=description["velocity_scale"],
        settings=Search(seed=context.seed, seconds=context.seconds, kinematic_prior=prior),
        report=context.say,
    )
    size = f"{solution.parameter_count} parameters, of the linear ones rank {solution.rank}, "
    context.say(f"learned tree: {size}condition {solution.condition:.3g}")
    how = {"loss": solution.torque_mse, "seconds": solution.seconds, "search": solution}
    objective = goal_of(settings, parts.sets)
    return refine(direct_fit(description, needs, parts, solution.parameters, objective, **how), parts, context)


def needs_of_tree(needs: Needs) -> Needs:
    """Converts the needs to those of a learned tree, whose friction is viscous, dry and an offset per joint.

    Raises:
        InputError: friction laws that a learned tree does not have.
    """
    laws = with_joint_laws(needs).joint_friction
    if others := [law for law in laws if law not in USUAL]:
        raise InputError(f"a learned tree has no {others[0]} friction; leave it out of joint_friction")
    return needs._replace(friction=bool(laws), joint_friction=())


def with_joint_laws(needs: Needs) -> Needs:
    """Needs with friction of the joints in place of friction by a network."""
    if not needs.friction:
        return needs
    return needs._replace(friction=False, joint_friction=needs.joint_friction or USUAL)


def parents_of(settings: Arm, d: int) -> tuple[int, ...] | None:
    """The stated parents of the joints, counted from 0, as everywhere else in the code."""
    if settings.parents is None:
        return None
    try:
        parents = tuple(int(number) - 1 for number in settings.parents.split(","))
    except ValueError:
        parents = ()
    if len(parents) != d or any(not -1 <= parent < link for link, parent in enumerate(parents)):
        raise InputError(
            f"--parents is {settings.parents!r:.60}; expected {d} whole numbers separated by commas: joints before, "
            "counted from 1, or 0 for the ground"
        )
    return parents


def kinematic_prior_of(settings: Arm, d: int, parents: tuple[int, ...] | None) -> KinematicPrior | None:
    """Reads the stated kinematic prior."""
    path = settings.kinematic_prior
    if path is None:
        return None
    try:
        return kinematic_prior_from_json(read_json(path, remedy="see --help"), d, parents)
    except InputError as error:
        raise InputError(str(error) if str(path) in str(error) else f"{path}: {error}") from None
