from dln_jax.__main__ import command

command("simulate", "python -m scripts.simulate")
