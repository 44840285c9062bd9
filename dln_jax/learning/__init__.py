"""Problems, objectives, and the one loop that solves them.

    training = fit(dynamics.problem(model, split(data)), GaussNewton())

`dynamics`, `matching`, `shooting` and `functions` build problems. Models that are linear in their parameters are solved
directly. `uncertainty` estimates the uncertainty of a fitted model.
"""
