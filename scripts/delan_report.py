from dln_jax.__main__ import command

command("delan_report", "python -m scripts.delan_report", package="scripts.reports.commands")
