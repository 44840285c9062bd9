"""What is wrong with a log before it is learned from: findings in one line each, with what to do about them.

`quick(data, robot)` looks at few torques, as commands that train do; `examine(recording, robot)` is what `check_data`
prints.
"""

from dln_jax.data.checks.doctor import Examination, examine, quick
from dln_jax.data.checks.findings import Finding, told
from dln_jax.data.checks.page import page
from dln_jax.data.checks.recording import Recording, as_recording, read

__all__ = ["Examination", "Finding", "Recording", "as_recording", "examine", "page", "quick", "read", "told"]
