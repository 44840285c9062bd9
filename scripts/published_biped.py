from dln_jax.__main__ import command

command("published_biped", "python -m scripts.published_biped", package="scripts.reports.commands")
