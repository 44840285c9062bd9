"""Log validation: findings about a log before it is used for learning, one line each with a remedy.

`quick(data, robot)` is run by commands that train; `examine(data, robot)` is the same with the results behind it,
which `check_data` prints.
"""
