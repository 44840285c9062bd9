"""Folders of runs: one writer at a time, and nothing left of what came to nothing."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from calls import one_line
from filelock import FileLock

from dln_jax import InputError
from dln_jax.files import write_json
from dln_jax.runs.folder import CONFIG, LOCK, run_folder
from tests.test_files import here, names  # noqa: F401  a fixture


def test_runs_that_start_together_get_folders_of_their_own():
    def start(_):
        with run_folder(None, "train") as folder:
            write_json(folder / "model.json", {})
        return folder

    with ThreadPoolExecutor(8) as pool:
        folders = list(pool.map(start, range(16)))
    assert sorted(folders) == sorted(Path("runs") / f"train-{number}" for number in range(1, 17))


def test_a_disk_without_locks_is_named(monkeypatch):
    def acquire(*_, **__):
        raise NotImplementedError("FileSystem does not appear to support flock; use SoftFileLock instead")

    monkeypatch.setattr(FileLock, "acquire", acquire)
    words = r"cannot write there .*does not appear to support flock.*another --out"
    with one_line(words), run_folder(Path("mine"), "x"):
        pass


def test_a_second_writer_is_refused_until_the_first_has_died():
    """A process that is killed leaves its lock file, and no lock."""
    code = (
        "import time; from pathlib import Path; from dln_jax.runs.folder import run_folder\n"
        "with run_folder(Path('shared'), 'x'): print('locked', flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as first:
        assert first.stdout.readline() == "locked\n"
        for resume in (False, True):
            words = "another process is writing there"
            with one_line(words), run_folder(Path("shared"), "x", resume=resume):
                pass
        first.kill()
    Path("shared/config.json.0123abcd.partial").touch()
    with run_folder(Path("shared"), "x"):
        assert names("shared") == [LOCK]


def test_a_run_that_came_to_nothing_leaves_nothing_and_one_that_did_stays():
    def fail(out, name=CONFIG, kind=InputError):
        with pytest.raises(kind), run_folder(out and Path(out), "train") as folder:
            write_json(folder / name, {})
            raise kind("no")

    fail(None)
    fail("a/b/c")
    assert names() == []
    Path("mine").mkdir()
    Path("mine/data.csv.partial").touch()
    fail("mine")
    assert names("mine") == ["data.csv.partial"], "what is not of a run is left alone"
    fail("mine", "checkpoint.json")
    assert names("mine") == [LOCK, "checkpoint.json", "data.csv.partial"]
    fail("interrupted", kind=KeyboardInterrupt)
    assert names("interrupted") == [LOCK, CONFIG], "it can be resumed"


def test_a_folder_that_is_none_or_holds_something_is_refused():
    Path("full").mkdir()
    Path("full/notes.txt").touch()
    Path("file").touch()
    Path("runs").symlink_to("nowhere")
    for out, message in (
        (Path("full"), "already contains"),
        (Path("file"), "cannot create"),
        (Path("file/below"), "cannot create"),
        (Path("runs"), "cannot create"),
        (Path("x" * 5000), "cannot create"),
        (None, "cannot create"),
    ):
        with one_line(message), run_folder(out, "train"):
            pass
    assert names("full") == ["notes.txt"] and names() == ["file", "full", "runs"]
