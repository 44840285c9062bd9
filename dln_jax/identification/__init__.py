"""Identification: what data of a robot determine of its parameters, and what these are.

`identify(model, parameters, data)` does all of it for a model linear in its parameters, such as `models.make_rigid_tree`.
"""
