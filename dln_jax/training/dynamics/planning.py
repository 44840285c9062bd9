"""From options and data to a task: what is refused, and the model that is trained."""

from dln_jax.cli.arguments import refuse_given, require_positive_if_given
from dln_jax.time_limit import deadline
from dln_jax.training.dynamics.methods import METHODS
from dln_jax.training.dynamics.options import AUTO, ArmOptions, Options, check_arm_options, check_direct_options
from dln_jax.training.dynamics.recorded import Recorded
from dln_jax.training.dynamics.task import Task, planned
from dln_jax.types import InputError, require_positive, require_seed


def check_options(given: Options, kind: str) -> None:
    """Refuses options that the model does not read."""
    if given.data is None:
        refuse_given(given, ["rate", "units"], "for a file: add --data")
    require_positive(seeds=given.seeds, folds=given.folds)
    require_positive_if_given(given, ["seconds"])
    require_seed(given.seed, given.seeds)
    if isinstance(given, ArmOptions):
        check_arm_options(given, kind)
    if kind != AUTO:
        METHODS[kind].check(given, kind)
        return
    if given.objective is not None:
        raise InputError(
            "--objective is for one model, and --model auto compares several by their torques; choose a --model "
            "with an energy, such as structured-delan, trigonometric or learned-tree, or leave --objective out"
        )
    check_direct_options(given, ("degree", "precision", "samples"), "model selection", "chooses by validation")


def task_of(given: Options, recorded: Recorded) -> Task:
    """The model that the arguments name, for these data; nothing is written yet.

    Raises:
        InputError: options that it does not read, or data that it cannot be fitted to.
    """
    kind = str(given.model)
    check_options(given, kind)
    return planned(METHODS[kind], given, kind, recorded, deadline(given.seconds))
