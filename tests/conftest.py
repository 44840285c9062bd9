"""Shared set-up: float64 everywhere, and programs compiled quickly rather than to run fast, and each only once."""

import atexit
import gc
import os
import shutil
import tempfile
from pathlib import Path

# As in the scripts: small factorisations on several threads burn the processor waiting for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import pytest
from jaxtyping import install_import_hook

ROOT = Path(__file__).resolve().parent.parent
UNCHECKED = "dln_jax.export.c"
"""Its arrays have no shapes in their types, and an export calls it half a million times."""
FILES = [*ROOT.glob("dln_jax/**/*.py"), *ROOT.glob("scripts/reports/**/*.py")]
ROOMS = [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in FILES]
ROOMS = [name.removesuffix(".__init__") for name in ROOMS if not name.startswith(UNCHECKED)]
# A name stands for all below it.
ROOMS = [name for name in ROOMS if not UNCHECKED.startswith(f"{name}.")]
install_import_hook(ROOMS, "typechecking.checked")

CACHE = "DLN_JAX_TEST_PROGRAMS"
"""Variable with the folder of compiled programs, which the test processes share: a run that is resumed has those of the
first."""
if CACHE not in os.environ:
    os.environ[CACHE] = tempfile.mkdtemp(prefix="dln_jax-tests-")
    atexit.register(shutil.rmtree, os.environ[CACHE], ignore_errors=True)
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_compilation_cache_dir", os.environ[CACHE])
LEAST_SECONDS = "0.02"
"""Of compilation, from which on a program is kept."""
jax.config.update("jax_persistent_cache_min_compile_time_secs", float(LEAST_SECONDS))

# Tracing makes many small objects that live on: collecting among them in vain costs a tenth of the time.
gc.set_threshold(200_000, 20, 100)

QUICKLY = [
    "--xla_backend_optimization_level=0",
    "--xla_llvm_disable_expensive_passes=true",
    "--xla_cpu_parallel_codegen_split_count=1",  # the test processes have the cores
]
if jax.__version_info__ < (0, 11):  # later ones do not know it, and abort at what they do not know
    QUICKLY.append("--xla_cpu_use_fusion_emitters=false")


def pytest_addoption(parser):
    parser.addoption("--optimised", action="store_true", help="compile programs as users do, which takes twice as long")
    parser.addoption("--every-export", action="store_true", help="compare all of every export with JAX, for minutes")


def pytest_configure(config):
    """Tests run each program a few times: compiling costs them more than running. Read when a device is first used."""
    if not config.getoption("--optimised"):
        os.environ["XLA_FLAGS"] = " ".join([os.environ.get("XLA_FLAGS", ""), *QUICKLY])


@pytest.fixture(scope="session", autouse=True)
def no_program_has_options_of_its_own(pytestconfig):
    """They would replace the tests' quicker ones."""
    from dln_jax import compilation  # not before the types of the library are checked

    with pytest.MonkeyPatch.context() as patch:
        if not pytestconfig.getoption("--optimised"):
            patch.setattr(compilation, "_OPTIONS", {})
        yield


LONGEST = """
    compilation readme examples families malformed fit measured_motions train_with_friction measured_joints
    mechanics delan learned_trees agreement functions arm_table checks train_models simulate train_delan
    uncertainty hamiltonian_tasks command_line identify data soft_energies hnn_tasks trees softbody_report
    benchmark residual_networks differential_mlp excite projection rigid_tree stability hamiltonian design
"""
"""Names of test files behind `test_`, the longest first."""


def pytest_collection_modifyitems(items):
    """The files that take longest come first, so that no process ends with one of them."""
    places = {f"test_{name}": place for place, name in enumerate(LONGEST.split())}
    items.sort(key=lambda item: places.get(item.path.stem, len(places)))
