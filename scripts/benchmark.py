from dln_jax.__main__ import command

command("benchmark", "python -m scripts.benchmark", package="scripts.reports.commands")
