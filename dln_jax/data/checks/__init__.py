"""Log validation: findings about a log before it is used for learning, one line each with a remedy.

`quick(data, robot)` looks at few torques and is run by commands that train; `examine(recording, robot)` is the full
examination that `check_data` prints.
"""

from dln_jax.data.checks.findings import Finding, by_severity
from dln_jax.data.checks.validation import Examination, Recording, as_recording, examine, quick, read, report

__all__ = ["Examination", "Finding", "Recording", "as_recording", "by_severity", "examine", "quick", "read", "report"]
