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

LIBRARY = Path(__file__).resolve().parent.parent / "dln_jax"
UNCHECKED = "dln_jax.deploy.c"
"""Its arrays have no shapes in their types, and an export calls it half a million times."""
ROOMS = [".".join(path.relative_to(LIBRARY.parent).with_suffix("").parts) for path in LIBRARY.glob("**/*.py")]
ROOMS = [name.removesuffix(".__init__") for name in ROOMS if not name.startswith(UNCHECKED)]
# A name stands for all below it.
ROOMS = [name for name in ROOMS if not UNCHECKED.startswith(f"{name}.")]
install_import_hook(ROOMS, "beartype.beartype")

CACHE = "DLN_JAX_TEST_PROGRAMS"
"""Variable with the folder of compiled programs, which the test processes share: a run that is resumed has those of the
first."""
if CACHE not in os.environ:
    os.environ[CACHE] = tempfile.mkdtemp(prefix="dln_jax-tests-")
    atexit.register(shutil.rmtree, os.environ[CACHE], ignore_errors=True)
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_compilation_cache_dir", os.environ[CACHE])
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.02)

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


LONGEST = (
    "test_compilation",
    "test_examples",
    *("test_softbody_report", "test_train_delan", "test_stability", "test_locomotion", "test_hnn_tasks", "test_pixels"),
    *(
        "test_soft_body_identification",
        "test_train_models",
        "test_levenberg_marquardt",
        "test_train_diffnet",
        "test_readme",
    ),
    *(
        "test_minimise",
        "test_soft_steps",
        "test_soft_energies",
        "test_simulate",
        "test_agreement",
        "test_families",
        "test_delan",
    ),
    "test_arm_table",
    *("test_mechanics", "test_n_body"),
)


def pytest_collection_modifyitems(items):
    """The files that take longest come first, so that no process ends with one of them."""
    places = {name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: places.get(item.path.stem, len(LONGEST)))
