"""Estimates the parameters of a robot, and says which of them its data determine.

`identify(model, known, data)` does both for a model that is linear in its parameters, such as
`make_rigid_tree`.
"""
