"""Trees of unknown joint frames: the frames by a search from random starts, everything else by elimination."""

from pathlib import Path
from typing import Any

from jax.sharding import Mesh

from dln_jax.learning.engine.problem import Training
from dln_jax.learning.kinematics import Search, fit_tree
from dln_jax.learning.objectives import Objective
from dln_jax.models.rigid_tree import USUAL
from dln_jax.training.dynamics.methods.direct import refined_if_asked, training_of
from dln_jax.training.dynamics.options import TreeOptions
from dln_jax.training.dynamics.recorded import Recorded
from dln_jax.training.dynamics.task import Method, Task
from dln_jax.types import InputError, Needs
from dln_jax.zoo.descriptions import describe_for


def needs_of_tree(needs: Needs) -> Needs:
    """Converts the needs to those of a learned tree, whose friction is viscous, dry and an offset per joint.

    Raises:
        InputError: friction laws that a learned tree does not have.
    """
    if others := [law for law in needs.joint_friction if law not in USUAL]:
        raise InputError(f"a learned tree has no {others[0]} friction; leave it out of joint_friction")
    return needs._replace(friction=needs.friction or bool(needs.joint_friction), joint_friction=())


def plan(options: TreeOptions, kind: str, recorded: Recorded, objective: Objective) -> tuple[dict[str, Any], None]:
    """The tree with the stated parents of its joints."""
    needs = needs_of_tree(recorded.needs)
    stated = {"parents": recorded.parents, "velocity_scale": needs.velocity_scale}
    return describe_for(
        kind, recorded.sets.train, needs, precision=getattr(options, "precision", None) or "f64", **stated
    ), None


def fit(task: Task, options: Any, folder: Path, mesh: Mesh | None) -> tuple[Task, Training]:
    """Joint frames by Gauss-Newton from random starts, or near the stated kinematics; all else by elimination."""
    needs, kinematic_prior = needs_of_tree(task.needs), task.recorded.kinematic_prior
    near = (
        {}
        if kinematic_prior is None
        else {
            "kinematic_prior": kinematic_prior.frames,
            "prior_angle": kinematic_prior.angle,
            "prior_length": kinematic_prior.length,
        }
    )
    solution = fit_tree(
        needs,
        task.sets.train,
        task.sets.validation,
        parents=task.description["parents"],
        acceleration=task.description["acceleration"],
        velocity_scale=task.description["velocity_scale"],
        settings=Search(seed=options.seed, seconds=task.seconds, **near),
        report=print,
    )
    size = f"{solution.parameter_count} parameters, of the linear ones rank {solution.rank}, "
    print(f"learned tree: {size}condition {solution.condition:.3g}")
    task = task._replace(search=solution)
    training = training_of(task, solution.parameters, solution.torque_mse, solution.seconds)
    return task, refined_if_asked(task, training)


METHOD = Method(plan, fit)
