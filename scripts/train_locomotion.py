from dln_jax.__main__ import command

command("train_locomotion")
