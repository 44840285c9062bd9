"""`python -m scripts.NAME` for each command of dln_jax."""
