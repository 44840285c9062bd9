"""Identification: estimate the parameters of a robot and say which of them its data determine.

`identify(model, known, data)` does both for a model that is linear in its parameters, such as
`models.trees.make_rigid_tree`.
"""
