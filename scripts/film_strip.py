from dln_jax.__main__ import command

command("film_strip", "python -m scripts.film_strip", package="scripts.reports.commands")
