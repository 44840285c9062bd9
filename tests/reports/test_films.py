"""Every film of the strip moves, and stays within its frame."""

import numpy as np
import pytest
from calls import command, refused

from scripts.reports.commands import film_strip
from scripts.reports.films import FILMS, sampled


def test_samples_begin_and_end_with_the_motion():
    motion = np.arange(101.0)
    assert sampled(motion, 5).tolist() == [0.0, 25.0, 50.0, 75.0, 100.0]


@pytest.mark.parametrize("option", ["--frames", "--frames-per-second"])
def test_a_strip_without_frames_is_refused(option, capsys, tmp_path):
    assert "expected a positive number" in refused(capsys, film_strip, option, "0", "--out", tmp_path / "strip")
    assert not (tmp_path / "strip").exists()


@pytest.mark.slow
def test_the_strip_is_written(tmp_path, monkeypatch):
    """The film that trains nothing; examples of the documentation train for the others."""
    title = "control by energy"
    monkeypatch.setattr(film_strip, "FILMS", {title: FILMS[title]})
    command(film_strip, "--frames", "3", "--out", tmp_path / "strip")
    assert (tmp_path / "strip" / "films.gif").read_bytes().startswith(b"GIF89a")
