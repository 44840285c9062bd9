from dln_jax.__main__ import command

command("verdict_report", "python -m scripts.verdict_report", package="scripts.reports.commands")
