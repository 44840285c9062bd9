"""Estimates the parameters of a robot, and says which of them its data determine.

`identify(model, known, data)` does both for a model that is linear in its parameters, such as `models.make_rigid_tree`.
"""
