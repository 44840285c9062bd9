from dln_jax.__main__ import command

command("softbody_report", "python -m scripts.softbody_report", package="scripts.reports.commands")
