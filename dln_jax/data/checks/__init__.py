"""Log validation: findings about a log before it is used for learning, one line each with a remedy.

`quick(data, robot)` is run by commands that train; `examine(recording, robot)` is the same with the results behind it,
which `check_data` prints.
"""

from dln_jax.data.checks.findings import Finding, by_severity
from dln_jax.data.checks.validation import Examination, Recording, as_recording, examine, quick, read, report

__all__ = ["Examination", "Finding", "Recording", "as_recording", "by_severity", "examine", "quick", "read", "report"]
