"""The commands that measure the project, one file each: `dln-jax report NAME`."""
