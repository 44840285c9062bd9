from dln_jax.__main__ import command

command("diffnet_report", "python -m scripts.diffnet_report", package="scripts.reports.commands")
