from dln_jax.__main__ import command

command("scale_report", "python -m scripts.scale_report", package="scripts.reports.commands")
