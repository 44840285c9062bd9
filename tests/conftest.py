"""Shared set-up: float64 everywhere, and programs compiled quickly rather than to run fast, and each only once."""

import atexit
import gc
import json
import os
import shutil
import tempfile
import time
from collections import Counter
from pathlib import Path

# As in the scripts: small factorisations on several threads burn the processor waiting for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Its own configuration closes all handlers of logging, those of pytest's captures too.
os.environ.setdefault("SUBMITIT_LOG_LEVEL", "NOCONFIG")

import jax
import jaxlib
import pytest
from jaxtyping import install_import_hook

ROOT = Path(__file__).resolve().parent.parent
UNCHECKED = "dln_jax.export.c"
"""Its arrays have no shapes in their types, and an export calls it half a million times."""
FILES = [*ROOT.glob("dln_jax/**/*.py"), *ROOT.glob("scripts/reports/**/*.py")]
CHECKED = [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in FILES]
CHECKED = [name.removesuffix(".__init__") for name in CHECKED if not name.startswith(UNCHECKED)]
# A name stands for all below it.
CHECKED = [name for name in CHECKED if not UNCHECKED.startswith(f"{name}.")]
TYPES = "DLN_JAX_TEST_TYPES"
"""Environment variable: if it is set, types are checked at every call, which takes a quarter of the time of tracing."""
if os.environ.get(TYPES):
    install_import_hook(CHECKED, "beartype.beartype")

PROGRAMS = "DLN_JAX_TEST_PROGRAMS"
"""Environment variable: folder of compiled programs, shared by the test processes and the commands that they start."""
LARGEST_FOLDER = 512 * 2**20
"""Bytes; one run of all tests leaves 40 MB. Programs of tests that have changed stay until this size is reached."""


def programs_folder():
    """Returns the folder of compiled programs, which stay between runs of the tests; each jaxlib has its own."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = cache / "dln_jax" / "test-programs" / jaxlib.__version__
    try:
        if folder.exists() and sum(program.stat().st_size for program in folder.iterdir()) > LARGEST_FOLDER:
            shutil.rmtree(folder)
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:  # a home that cannot be written to
        folder = Path(tempfile.mkdtemp(prefix="dln_jax-tests-"))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return str(folder)


if PROGRAMS not in os.environ:
    os.environ[PROGRAMS] = programs_folder()
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_compilation_cache_dir", os.environ[PROGRAMS])
SHORTEST_COMPILATION = "0.02"
"""Seconds; reading a program takes about 0.01 s, so that one that compiles faster is not worth a file."""
jax.config.update("jax_persistent_cache_min_compile_time_secs", float(SHORTEST_COMPILATION))
# Locations of operations take a twentieth of the time of tracing and lowering, and no test reads them.
jax.config.update("jax_traceback_in_locations_limit", 0)

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
    parser.addoption("--slow", action="store_true", help="run the tests marked slow, too")
    parser.addoption("--slow-within", type=float, metavar="S", help="skip the slow tests not begun after S seconds")
    parser.addoption("--time-tests", action="store_true", help="store how long tests take, which orders and marks them")
    parser.addoption("--pinned", action="store_true", help="compare the numbers of commands with those in tests/pinned")
    parser.addoption("--renew", action="store_true", help="store what tests/pinned measures, and compare nothing")
    parser.addoption("--every-export", action="store_true", help="compare all of every export with JAX, for minutes")


def pytest_configure(config):
    """Sets XLA's options before a device is first used: a test runs its programs less long than it compiles them."""
    if config.getoption("--slow") and config.option.markexpr == "not slow":  # and not what was asked for by -m
        config.option.markexpr = ""
    if not config.getoption("--optimised"):
        os.environ["XLA_FLAGS"] = " ".join([os.environ.get("XLA_FLAGS", ""), *QUICKLY])


STARTED = time.monotonic()


def pytest_runtest_setup(item):
    """Skips a test marked slow that would begin after the limit of --slow-within; -rs prints each."""
    limit = item.config.getoption("--slow-within")
    if limit and item.get_closest_marker("slow") and time.monotonic() - STARTED > limit:
        pytest.skip(f"NOT REACHED: marked slow, and {limit:g} s had passed")


@pytest.fixture(scope="session", autouse=True)
def no_program_has_options_of_its_own(pytestconfig):
    """They would replace the tests' quicker ones."""
    from dln_jax import precision  # not before the types of the library are checked

    with pytest.MonkeyPatch.context() as patch:
        if not pytestconfig.getoption("--optimised"):
            patch.setattr(precision, "_OPTIONS", {})
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """An empty working folder for all tests of a file, with a cache of its own."""
    folder = tmp_path_factory.mktemp("folder")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
        yield folder


def slow_among(values, is_slow):
    """Returns parameters of a test, marked slow where `is_slow(value)`."""
    return [pytest.param(value, marks=[pytest.mark.slow] * is_slow(value)) for value in values]


DURATIONS = ROOT / "tests" / "durations.json"
"""Seconds of test functions with all their parameters, of those that take one or more, by --time-tests."""
LONGEST = 3.0
"""Seconds; a function that takes longer is marked slow."""
SECONDS: Counter[str] = Counter()
LAST = ("test_readme", "test_examples")
"""The documentation's two long files, one for each process: a limit of time leaves out a page before a property."""


def stored_durations():
    return json.loads(DURATIONS.read_text())


def function_of(name):
    return name.split("[")[0]


def pytest_runtest_logreport(report):
    SECONDS[function_of(report.nodeid)] += report.duration


def pytest_sessionfinish(session):
    """Stores the durations, in the process that has heard of all tests."""
    if session.config.getoption("--time-tests") and not hasattr(session.config, "workerinput"):
        seconds = stored_durations() | SECONDS
        kept = {name: round(seconds[name], 1) for name in sorted(seconds) if seconds[name] >= 1}
        DURATIONS.write_text(json.dumps(kept, indent=1) + "\n")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Marks what takes long; the longest files come first, so that no process ends with one of them alone."""
    stored, files = stored_durations(), Counter()
    for name, seconds in stored.items():
        files[name.split("::")[0]] += seconds
    for item in items:
        if stored.get(function_of(item.nodeid), 0) > LONGEST:
            item.add_marker("slow")
    items.sort(key=lambda item: (item.path.stem in LAST, -files[item.location[0]]))
