"""The command `train_hnn_task` of dln_jax."""

from dln_jax.__main__ import command

command("train_hnn_task", "python -m scripts.train_hnn_task")
