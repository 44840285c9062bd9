from dln_jax.__main__ import command

command("stability", "python -m scripts.stability", package="scripts.reports.commands")
