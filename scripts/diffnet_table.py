"""The command `diffnet_table` of dln_jax."""

from dln_jax.__main__ import command

command("diffnet_table", "python -m scripts.diffnet_table")
