"""Locomotion of soft creatures: policies learned by gradients through the simulator."""

from dln_jax.locomotion.gradient import TrainedPolicies, shown_walk, train
from dln_jax.locomotion.learning import Goal, Learned, Record
from dln_jax.locomotion.task import LocomotionTask, creature_named, make_task
from dln_jax.locomotion.worlds import Variation

__all__ = [
    "Goal",
    "Learned",
    "LocomotionTask",
    "Record",
    "TrainedPolicies",
    "Variation",
    "creature_named",
    "make_task",
    "shown_walk",
    "train",
]
