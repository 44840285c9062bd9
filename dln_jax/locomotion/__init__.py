"""Locomotion of soft creatures: policies learned by gradients through the simulator, or by evolution."""

from dln_jax.locomotion.learning import Goal, Learned, Record
from dln_jax.locomotion.methods import Trained, shown_walk, train
from dln_jax.locomotion.task import Task, creature_named, make_task

__all__ = ["Goal", "Learned", "Record", "Task", "Trained", "creature_named", "make_task", "shown_walk", "train"]
