from dln_jax.__main__ import command

command("compare_locomotion", "python -m scripts.compare_locomotion", package="scripts.reports.commands")
