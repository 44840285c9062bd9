from dln_jax.__main__ import command

command("diffnet_table", "python -m scripts.diffnet_table", package="scripts.reports.commands")
