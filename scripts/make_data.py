from dln_jax.__main__ import command

command("make_data", "python -m scripts.make_data")
