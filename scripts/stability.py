"""The command `stability` of dln_jax."""

from dln_jax.__main__ import command

command("stability", "python -m scripts.stability")
