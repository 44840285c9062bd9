"""The command `train_locomotion` of dln_jax."""

from dln_jax.__main__ import command

command("train_locomotion", "python -m scripts.train_locomotion")
