from dln_jax.__main__ import command

command("delan_derivatives_report", "python -m scripts.delan_derivatives_report", package="scripts.reports.commands")
