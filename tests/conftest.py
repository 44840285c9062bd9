"""Shared set-up: float64 everywhere, and programs compiled quickly rather than to run fast, and each only once."""

import os

# Tests run each program a few times: compiling costs them more than running. Read when the first device is used.
os.environ["XLA_FLAGS"] = " ".join(
    (
        os.environ.get("XLA_FLAGS", ""),
        "--xla_backend_optimization_level=0",
        "--xla_llvm_disable_expensive_passes=true",
        "--xla_cpu_use_fusion_emitters=false",
    )
)

# As in the scripts: small factorisations on several threads burn the processor waiting for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import atexit
import gc
import shutil
import tempfile

import jax

CACHE = "DLN_JAX_TEST_PROGRAMS"
"""Variable with the folder of compiled programs, which the test processes share: a run that is resumed has those of the
first."""
if CACHE not in os.environ:
    os.environ[CACHE] = tempfile.mkdtemp(prefix="dln_jax-tests-")
    atexit.register(shutil.rmtree, os.environ[CACHE], ignore_errors=True)
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_compilation_cache_dir", os.environ[CACHE])
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)

# Tracing makes many small objects that live on: collecting among them in vain costs a tenth of the time.
gc.set_threshold(200_000, 20, 100)

LONGEST = (
    *("test_softbody_report", "test_train_delan", "test_stability", "test_locomotion", "test_hnn_tasks", "test_pixels"),
    *("test_soft_body_identification", "test_train_models", "test_gauss_newton", "test_train_diffnet", "test_readme"),
    *(
        "test_minimise",
        "test_soft_steps",
        "test_soft_energies",
        "test_simulate",
        "test_export_c",
        "test_delan",
        "test_arm_table",
    ),
    *("test_mechanics", "test_n_body"),
)


def pytest_collection_modifyitems(items):
    """The files that take longest come first, so that no process ends with one of them."""
    places = {name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: places.get(item.path.stem, len(LONGEST)))
