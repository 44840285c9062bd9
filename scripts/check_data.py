from dln_jax.__main__ import command

command("check_data")
