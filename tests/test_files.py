"""Files are whole or not there, and what is read is checked."""

import json
import math
import os
from pathlib import Path

import pytest
from calls import one_line
from matplotlib.figure import Figure

from dln_jax.files import cache_folder, matches, read_json, write_figure, write_json, writing
from dln_jax.runs import devices
from dln_jax.types import InputError


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def names(folder="."):
    return sorted(path.name for path in Path(folder).iterdir())


def test_a_user_without_a_home_folder_is_told_and_default_data_need_none(monkeypatch):
    from dln_jax.scenes.datasets import generators
    from dln_jax.scenes.registry import scene_named

    def no_home():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", no_home)
    with pytest.raises(InputError, match="no home folder; set XDG_CACHE_HOME"):
        cache_folder()
    assert devices.keep_programs(True) == "" or "XDG_CACHE_HOME" in devices.keep_programs(True)
    assert generators.default_data(scene_named("pendulum")).degrees_of_freedom == 1
    assert names() == []


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


def test_what_is_no_json_object_is_refused_in_one_line():
    for text in ["", "{", "[]", "3", "[" * 100_000, "\x00", '{"a": 1' + "0" * 5000 + "}"]:
        Path("file.json").write_text(text)
        for path in ("file.json", "missing.json", "x" * 5000):
            with one_line("try again"):
                read_json(Path(path), remedy="try again")


def test_json_values_are_told_apart_by_type():
    assert matches(1, int) and matches(1, float) and matches(None, float | None) and matches("a", Path | None)
    wrong = (
        (True, int),
        (1.0, int),
        (math.inf, float),
        ("1", float),
        (2**80, float),
        (None, float),
        (["1"], list[int]),
    )
    assert not any(matches(value, hint) for value, hint in wrong)
