"""Log validation: findings about a log before it is used for learning, one line each with a remedy.

`quick(data, robot)` looks at few torques and is run by commands that train; `examine(recording, robot)` is the full
examination that `check_data` prints.
"""

from dln_jax.data.checks.doctor import Examination, examine, quick
from dln_jax.data.checks.findings import Finding, told
from dln_jax.data.checks.page import page
from dln_jax.data.checks.recording import Recording, as_recording, read

__all__ = ["Examination", "Finding", "Recording", "as_recording", "examine", "page", "quick", "read", "told"]
