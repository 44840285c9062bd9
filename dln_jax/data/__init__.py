"""Trajectories: the npz schema, validation, splits, and generators that sample the scenes."""
