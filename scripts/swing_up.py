from dln_jax.__main__ import command

command("swing_up", "python -m scripts.swing_up")
