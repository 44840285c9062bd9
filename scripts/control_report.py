from dln_jax.__main__ import command

command("control_report", "python -m scripts.control_report", package="scripts.reports.commands")
