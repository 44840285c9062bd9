from dln_jax.__main__ import command

command("train_hnn", "python -m scripts.train_hnn")
