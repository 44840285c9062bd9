from dln_jax.__main__ import command

command("uncertainty_report", "python -m scripts.uncertainty_report", package="scripts.reports.commands")
