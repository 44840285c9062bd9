from dln_jax.__main__ import command

command("walk_report", "python -m scripts.walk_report", package="scripts.reports.commands")
