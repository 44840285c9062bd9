"""Meshes, energy terms and implicit time steps that minimise an incremental potential.

`mesh` builds bodies and `terms` their energies. A scene holds both, and `make_step` returns its time step.

SciPy's OpenBLAS, which factorises for JAX on a CPU, is set to one thread unless `OPENBLAS_NUM_THREADS` says otherwise:
its threads spin while they wait for the small matrices of a step, which took 2 to 50 times the processor time.
"""

import ctypes
import os
from pathlib import Path

if "OPENBLAS_NUM_THREADS" not in os.environ:
    # OpenBLAS reads the variable when it is loaded; SciPy's own copy can be told later as well.
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    import scipy.linalg

    del os.environ["OPENBLAS_NUM_THREADS"]
    for path in Path(scipy.__file__).parents[1].glob("scipy.libs/*scipy_openblas*"):
        ctypes.CDLL(str(path)).scipy_openblas_set_num_threads(1)
