"""Folders and files of runs: one writer at a time, whole files or none, and nothing left of what came to nothing."""

import json
import math
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from dln_jax.files import CONFIG, LOCK, matches, read_json, run_folder, write_figure, write_json, writing
from dln_jax.types import InputError


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def names(folder="."):
    return sorted(path.name for path in Path(folder).iterdir())


def test_runs_that_start_together_get_folders_of_their_own():
    def start(_):
        with run_folder(None, "train") as folder:
            write_json(folder / "model.json", {})
        return folder

    with ThreadPoolExecutor(8) as pool:
        folders = list(pool.map(start, range(16)))
    assert sorted(folders) == sorted(Path("runs") / f"train-{number}" for number in range(1, 17))


def test_a_second_writer_is_refused_until_the_first_has_died():
    """A process that is killed leaves its lock file, and no lock."""
    code = (
        "import sys, time; from pathlib import Path; from dln_jax.files import run_folder\n"
        "with run_folder(Path('shared'), 'x'): print('locked', flush=True); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as first:
        assert first.stdout is not None and first.stdout.readline() == "locked\n"
        for resume in (False, True):
            message = "another process is writing there"
            with pytest.raises(InputError, match=message), run_folder(Path("shared"), "x", resume=resume):
                pass
        first.kill()
    Path("shared/config.json.0123abcd.partial").touch()
    with run_folder(Path("shared"), "x"):
        assert names("shared") == [LOCK]
    with run_folder(Path("shared"), "x", resume=True):
        pass


def test_a_run_that_came_to_nothing_leaves_nothing_and_one_that_did_stays():
    def fail(out, name=CONFIG, kind=InputError):
        with pytest.raises(kind), run_folder(out, "train") as folder:
            write_json(folder / name, {})
            raise kind("no")

    fail(None)
    fail(Path("a/b/c"))
    assert names() == []
    Path("mine").mkdir()
    Path("mine/data.csv.partial").touch()
    fail(Path("mine"))
    assert names("mine") == ["data.csv.partial"], "what is not of a run is left alone"
    fail(Path("mine"), "checkpoint.json")
    assert names("mine") == [LOCK, "checkpoint.json", "data.csv.partial"]
    fail(Path("interrupted"), kind=KeyboardInterrupt)
    assert names("interrupted") == [LOCK, CONFIG], "it can be resumed"


def test_a_folder_that_is_none_or_holds_something_is_refused():
    Path("full").mkdir()
    Path("full/notes.txt").touch()
    Path("file").touch()
    Path("link").symlink_to("nowhere")
    for out, message in (
        ("full", "not empty"),
        ("file", "cannot create"),
        ("file/below", "cannot create"),
        ("link", "cannot create"),
        ("x" * 5000, "cannot create"),
    ):
        with pytest.raises(InputError, match=message), run_folder(Path(out), "train"):
            pass
    assert names("full") == ["notes.txt"] and names() == ["file", "full", "link"]
    Path("runs").symlink_to("nowhere")
    with pytest.raises(InputError, match="cannot create"), run_folder(None, "train"):
        pass


def test_a_file_is_written_whole_or_not_at_all_and_through_no_link():
    Path("precious").write_text("precious")
    os.symlink("precious", "report.json")
    write_json(Path("report.json"), {"rows": [1.0, math.inf, (math.nan, None)]})
    assert Path("precious").read_text() == "precious" and not Path("report.json").is_symlink()
    assert json.loads(Path("report.json").read_text()) == {"rows": [1.0, None, [None, None]]}
    with pytest.raises(RuntimeError), writing(Path("report.json")) as partial:
        partial.write_text("half")
        raise RuntimeError
    write_figure(Path("figure.png"), Figure())
    assert Path("figure.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(InputError, match="no such folder"):
        write_json(Path("missing/file.json"), {})
    assert names() == ["figure.png", "precious", "report.json"]


@pytest.mark.parametrize("text", ["", "{", "[]", "3", "[" * 100_000, "\x00", '{"a": 1' + "0" * 5000 + "}"])
def test_what_is_no_json_object_is_refused_in_one_line(text):
    Path("file.json").write_text(text)
    for path in ("file.json", "missing.json", "x" * 5000):
        with pytest.raises(InputError, match="try again") as caught:
            read_json(Path(path), remedy="try again")
        assert "\n" not in str(caught.value)


def test_json_values_are_told_apart_by_type():
    assert matches(1, int) and matches(1, float) and matches(None, float | None) and matches("a", Path | None)
    wrong = ((True, int), (1.0, int), (math.inf, float), ("1", float), (2**80, float), (None, float), ([1], list[int]))
    assert not any(matches(value, hint) for value, hint in wrong)
