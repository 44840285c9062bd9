from dln_jax.__main__ import command

command("interruptions", "python -m scripts.interruptions", package="scripts.reports.commands")
