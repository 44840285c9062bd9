from dln_jax.__main__ import command

command("hnn_table", "python -m scripts.hnn_table", package="scripts.reports.commands")
