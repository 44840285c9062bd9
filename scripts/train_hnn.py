"""The command `train_hnn` of dln_jax."""

from dln_jax.__main__ import command

command("train_hnn", "python -m scripts.train_hnn")
