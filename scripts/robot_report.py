from dln_jax.__main__ import command

command("robot_report", "python -m scripts.robot_report", package="scripts.reports.commands")
