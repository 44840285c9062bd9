"""The examples of the documentation, at reduced size: each ends with its own assertions of physics."""

import re
from pathlib import Path

import matplotlib.pyplot as plt
import pytest
from matplotlib.figure import Figure

from dln_jax.figures.style import write_gif

FOLDER = Path(__file__).parents[2] / "docs" / "examples"
EXAMPLES = sorted(FOLDER.glob("[0-9]*.py"))
REDUCED = {
    "01_spherical_pendulum": {"SECONDS": 2},
    "02_train_the_arm": {"ITERATIONS": 15},
    "03_measured_pendulum": {"ITERATIONS": 7},
    "04_two_bodies": {"TRAJECTORIES": 20, "ITERATIONS": 25, "SECONDS": 5},
    "05_differential_network": {"SAMPLES": 500},
    "06_soft_body": {"STEPS": 30, "RINGS": 2},
    "07_gait": {"GOAL": 1.0},
    "08_c_in_a_loop": {},
    "09_fine_tune": {"ITERATIONS": 5},
    "10_encoder_log_to_c": {},
    "11_swing_up": {"STARTS": 2, "FRAMES_PER_SECOND": 1.0},
    "12_stiff_plant": {},
    "13_own_mesh": {"STEPS": 6, "TURNS": 2},
    "14_bodies_that_touch": {"STEPS": 20, "CELLS": 12},
    "15_pressure_gripper": {"STEPS": 32, "RINGS": 2},
    "16_down_the_stairs": {"STEPS": 60, "COUNT": 1},
    "17_stiffness_from_a_motion": {},
    "18_tangle": {"STEPS": 40, "STRIPS": 3},
    "19_predictive_control": {"SECONDS": 2.0, "FRAMES_PER_SECOND": 2.0},
    "20_state_estimation": {"SECONDS": 1.0},
    "21_gymnasium_environment": {"SAMPLES": 50},
    "22_gymnasium_creature": {"STEPS": 30},
}
"""Constants of the examples, and what they are here."""


def reduced(path):
    source = path.read_text()
    for name, value in REDUCED[path.stem].items():
        line = re.search(rf"^(.*\b{name}\b.*) = (.*)$", source, re.MULTILINE)
        assert line is not None, f"{path.stem} sets no {name}"
        names, values = ([part.strip() for part in re.split(",| #", side)] for side in line.groups())
        values = values[: len(names)]
        values[names.index(name)] = str(value)
        source = source.replace(line.group(0), f"{', '.join(names)} = {', '.join(values)}")
    return source


def first_and_last(*arguments, frames, **options):
    """Writes the first and the last frame of a film; its drawing has tests of its own."""
    write_gif(*arguments, frames=[frames[0], frames[-1]], **options)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs_and_its_assertions_hold(path, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.syspath_prepend(FOLDER)
    monkeypatch.setattr("slab_films.write_gif", first_and_last)
    source = path.read_text()
    assert re.search(r"^assert ", source, re.MULTILINE), "an example checks its physics"
    try:
        names = {"__name__": "__main__"}
        exec(compile(reduced(path), str(path), "exec"), names)
        assert any(isinstance(value, Figure) for value in names.values()), "an example has a picture"
    finally:
        plt.close("all")
    assert re.search(r"\d", capsys.readouterr().out)


def test_every_example_has_its_size():
    assert set(REDUCED) == {path.stem for path in EXAMPLES}
