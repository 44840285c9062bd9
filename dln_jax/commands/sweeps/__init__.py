"""Sweeps: a grid of one command's options as independent jobs on existing executors, and a comparison of the runs."""
