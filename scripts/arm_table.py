from dln_jax.__main__ import command

command("arm_table", "python -m scripts.arm_table", package="scripts.reports.commands")
