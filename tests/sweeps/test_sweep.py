"""A sweep from the shell: what is done, fails and is killed, what is chosen; --resume does only what is left."""

import contextlib
import csv
import json
import os
import signal
import threading
import time

import numpy as np
import pytest
from calls import command, refused

from dln_jax.commands import sweep
from dln_jax.data import schema
from dln_jax.datasets import generators
from dln_jax.figures.sweeps import Point, error_against_seconds
from dln_jax.scenes.registry import scene_named
from dln_jax.sweeps import engines, work
from dln_jax.sweeps import sweep as course
from dln_jax.sweeps.engines import Engine
from dln_jax.sweeps.status import Status, status_of, write_status
from dln_jax.types import InputError

WIDTHS = {"2": 3e-3, "4": 1e-4, "8": 2e-4}
"""Validation errors of pretended trainings; seeds add to them."""


def trained(line):
    """Pretends to be a command: its test error is least where its validation is worst."""
    given = dict(word.removeprefix("--").split("=", 1) for word in line[1:] if "=" in word)
    width, seed = given["width"], int(given["seed"])
    out = os.path.join(given["out"], "")
    os.makedirs(out, exist_ok=True)
    with open(out + "config.json", "w") as config:
        config.write("{}")
    print(f"training of width {width}")
    if width == "8" and seed == 1 and "--resume" not in line:
        os.write(2, b"error: the loss stopped being finite\n")
        return 2
    validation = WIDTHS[width] * (1 + seed)
    with open(out + "metrics.json", "w") as metrics:
        json.dump(
            {"validation_error": validation, "torque_mse": 1e-7 / validation, "train_seconds": 1.0 + seed}, metrics
        )
    return 0


@pytest.fixture(autouse=True)
def no_logger_of_submitit(monkeypatch):
    """It would keep the stream of the test that imports it."""
    monkeypatch.setenv("SUBMITIT_LOG_LEVEL", "NOCONFIG")


@pytest.fixture
def engine(monkeypatch):
    """Jobs one after the other in this process; the first time that of width 2 and seed 1 is killed as it begins."""
    begun = []

    def start(paths):
        for path in paths:
            values = json.loads(path.read_text())["values"]
            begun.append(values)
            if values == {"width": "2", "seed": "1"} and begun.count(values) == 1:
                write_status(path.parent, Status("running", attempt=1, run="run"))
                continue
            with contextlib.suppress(SystemExit):
                work.Work()(str(path))
        return paths

    monkeypatch.setattr(work, "exit_code", trained)
    monkeypatch.setattr(engines, "SECONDS_BETWEEN_LOOKS", 0.0)
    made = Engine(start, lambda path: "OUT_OF_MEMORY", lambda paths: None, at_once=2)
    monkeypatch.setattr(course, "engine_of", lambda asked, folder, jobs: contextlib.nullcontext(made))
    return begun


@pytest.mark.parametrize("option", ["metric", "error"])
def test_unknown_metrics_are_refused_and_jobs_are_kept(tmp_path, engine, capfd, option):
    out = tmp_path / "sweep"
    with pytest.raises(SystemExit) as stop:
        command(sweep, "--grid", "width=4 seed=0:2", "--out", out, f"--{option}", "torque_msee")
    said = capfd.readouterr().err
    assert stop.value.code == 2 and not (out / "table.csv").exists()
    assert f"--{option}: no job has the metric 'torque_msee'; choose from torque_mse, train_seconds, valid" in said
    begun = len(engine)
    command(sweep, "--out", out, "--resume", f"--{option}", "torque_mse")
    assert len(engine) == begun == 2 and (out / "table.csv").is_file()


def test_a_sweep_is_done_and_only_what_is_left_is_done_again(tmp_path, engine, capfd):
    out = tmp_path / "sweep"
    with pytest.raises(SystemExit) as stop:
        command(sweep, "--grid", "width=2,4,8 seed=0:3", "--fixed", "steps=3", "--out", out)
    said = capfd.readouterr().out
    assert stop.value.code == 1 and len(engine) == 9
    found = json.loads((out / "sweep.json").read_text())
    states = [job["state"] for job in found["jobs"]]
    assert states == ["done", "killed", *["done"] * 5, "failed", "done"]
    assert "0001 killed: ended without a word (OUT_OF_MEMORY)" in said
    assert "0007 failed: the loss stopped being finite" in said and "training of width" not in said
    assert (out / "sweep.png").read_bytes().startswith(b"\x89PNG")
    # Validation chooses, and the test errors are such that it is the worst of them.
    (best,) = [job["values"] for job in found["jobs"] if job["best"]]
    assert best == {"width": "4", "seed": "0"}
    with (out / "table.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 9 and float(rows[3]["validation_error"]) == 1e-4 and rows[7]["validation_error"] == ""
    assert max(rows, key=lambda row: float(row["torque_mse"] or 0))["best"] == "1"
    # Medians over seeds, by hand.
    of = {group["values"]["width"]: group for group in found["groups"]}
    assert of["4"]["medians"]["validation_error"] == pytest.approx(2e-4) and of["4"]["worst"]["train_seconds"] == 3.0
    assert of["2"]["done"] == 2 and of["2"]["medians"]["validation_error"] == pytest.approx(np.median([3e-3, 9e-3]))

    command(sweep, "--out", out, "--resume", "--best", "largest")
    assert engine[9:] == [{"width": "2", "seed": "1"}, {"width": "8", "seed": "1"}]
    found = json.loads((out / "sweep.json").read_text())
    assert {job["state"] for job in found["jobs"]} == {"done"}
    (best,) = [job for job in found["jobs"] if job["best"]]
    assert best["values"] == {"width": "2", "seed": "2"}
    # What was begun was continued, in its folder.
    assert status_of(out / "jobs" / "0007")[:4] == ("done", "", 2, "run")
    command(sweep, "--out", out, "--resume")
    assert len(engine) == 11


def test_jobs_for_later_are_done_by_anything(tmp_path, engine, capsys):
    out = tmp_path / "sweep"
    command(sweep, "--grid", "width=2,4 seed=0", "--where", "later", "--out", out)
    assert "python -m dln_jax.sweeps.work" in capsys.readouterr().out and not (out / "sweep.json").exists()
    for path in sorted((out / "jobs").glob("*/job.json")):
        assert work.perform(path) == 0
    command(sweep, "--out", out, "--resume", "--where", "here")
    assert not engine and "best by validation_error: width=4" in capsys.readouterr().out


def test_what_cannot_be_continued_is_begun_anew(tmp_path, engine):
    for attempt in (1, 2):
        with contextlib.suppress(SystemExit):
            command(sweep, "--grid", "width=8 seed=1", "--out", tmp_path / "sweep", *["--resume"] * (attempt - 1))
        (job,) = (tmp_path / "sweep" / "jobs").iterdir()
        stored = json.loads((job / "job.json").read_text())
        (job / "job.json").write_text(json.dumps(stored | {"resumes": False}))
    assert status_of(job).run == "run-2"


STATUS = {
    "a run elsewhere": {"run": "../../X"},
    "a run at the root": {"run": "/tmp/X"},
    "a run that is a number": {"run": 5},
    "attempts in words": {"attempt": "x"},
    "attempts below zero": {"attempt": -1},
    "an unknown state": {"state": "happy"},
    "seconds in words": {"seconds": "few"},
}


@pytest.mark.parametrize("damage", STATUS)
def test_a_status_that_is_not_a_job_s_own_is_refused(tmp_path, engine, capsys, damage):
    out = tmp_path / "sweep"
    command(sweep, "--grid", "width=4 seed=0", "--out", out)
    path = out / "jobs" / "0000" / "status.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **STATUS[damage]}))
    assert "status.json" in refused(capsys, sweep, "--out", out, "--resume")
    assert not (tmp_path / "X").exists() and len(engine) == 1


def test_a_job_that_is_done_without_a_run_is_done_again(tmp_path, engine):
    out = tmp_path / "sweep"
    command(sweep, "--grid", "width=4 seed=0", "--out", out)
    for run in (out / "jobs" / "0000" / "run").iterdir():
        run.unlink()
    command(sweep, "--out", out, "--resume")
    assert len(engine) == 2


@pytest.mark.parametrize(
    "change", [{"arguments": "x"}, {"arguments": [1]}, {"command": 3}, {"folder": "/nowhere"}], ids=str
)
def test_a_damaged_job_is_refused(tmp_path, engine, capsys, change):
    out = tmp_path / "sweep"
    command(sweep, "--grid", "width=4 seed=0", "--where", "later", "--out", out)
    path = out / "jobs" / "0000" / "job.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    assert "job.json" in refused(capsys, sweep, "--out", out, "--resume", "--where", "here")
    with pytest.raises(InputError, match=r"job\.json"):
        work.perform(path)


def test_the_best_is_of_each_problem(tmp_path, engine):
    for name in "ab":
        (tmp_path / name).touch()
    command(
        sweep,
        "--grid",
        f"data={tmp_path}/a,{tmp_path}/b width=2,4 seed=0:2",
        "--over",
        "seed,width",
        "--out",
        tmp_path / "s",
    )
    found = json.loads((tmp_path / "s" / "sweep.json").read_text())
    assert [job["values"]["width"] for job in found["jobs"] if job["best"]] == ["4", "4"]
    assert [group["jobs"] for group in found["groups"]] == [4, 4]


def test_an_interrupt_ends_the_jobs(tmp_path, engine, monkeypatch, capsys):
    stopped = []

    def interrupted(handle):
        raise KeyboardInterrupt

    made = Engine(list, interrupted, stopped.extend, at_once=2)
    monkeypatch.setattr(course, "engine_of", lambda asked, folder, jobs: contextlib.nullcontext(made))
    with pytest.raises(SystemExit) as stop:
        command(sweep, "--grid", "width=2,4,8 seed=0", "--out", tmp_path / "s")
    assert stop.value.code == 130 and f"continue with: sweep --out {tmp_path}/s --resume" in capsys.readouterr().err
    assert [path.parent.name for path in stopped] == ["0000", "0001"]


MISTAKES = [
    (("--grid", "width=a"), "--width must be a whole number"),
    ((), "--grid names no option"),
    (("--command", "train_delen", "--grid", "width=8"), "did you mean train_delan?"),
    (("--command", "sweep", "--grid", "width=8"), "there is no 'sweep'"),
    (("--command", "make_data", "--grid", "seed=0:2"), "make_data"),
    (("--grid", "width=8", "--over", "seed"), "'seed' is not in --grid"),
    (("--grid", "width=8", "--jobs", "0"), "jobs is 0"),
    (("--grid", "width=8", "--jobs", "4", "--gpus", "2"), "each job has one"),
    (("--grid", "width=8", "--where", "slurm"), "no sbatch on the PATH"),
]


@pytest.mark.parametrize(("arguments", "message"), MISTAKES)
def test_mistakes_are_one_line_and_leave_nothing(arguments, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert message in refused(capsys, sweep, *arguments)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("where", "package", "extra"), [("here", "submitit", "sweep"), ("ray", "ray", "ray")])
def test_an_engine_that_is_missing_is_named(where, package, extra, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, package, None)
    line = refused(capsys, sweep, "--grid", "width=8", "--where", where, "--out", tmp_path / "s")
    assert f"pip install 'dln-jax[{extra}]'" in line and not (tmp_path / "s").exists()


def test_another_grid_is_refused(tmp_path, engine, capsys):
    command(sweep, "--grid", "width=2 seed=0", "--out", tmp_path / "s")
    line = refused(capsys, sweep, "--grid", "width=4 seed=0", "--out", tmp_path / "s", "--resume")
    assert "was started with grid = width=2 seed=0" in line


def test_the_figure_shows_every_run_and_rings_the_best():
    points = [Point(1.0, 1e-3, "4"), Point(2.0, 1e-5, "8", best=True), Point(1.5, 1e-4, median=True)]
    drawn = error_against_seconds(points, x="training, s", y="torque", colour="width", note="3 jobs, of which 1 failed")
    (axis,) = drawn.axes
    assert [line.get_xydata()[0].tolist() for line in axis.lines].count([2.0, 1e-5]) == 2
    assert len(axis.lines) == 4 and axis.get_yscale() == "log"
    (legend,) = drawn.legends
    assert legend.get_title().get_text() == "3 jobs, of which 1 failed"


def kill_as_it_begins(job):
    """SIGKILL to a job's process as soon as it says that it runs."""
    until = time.monotonic() + 60
    while time.monotonic() < until and (status := status_of(job)).state != "running":
        time.sleep(0.002)
    os.kill(status.process, signal.SIGKILL)


@pytest.mark.parametrize(("where", "package"), [("here", "submitit"), ("ray", "ray")])
def test_jobs_in_processes_of_their_own(where, package, tmp_path, capsys):
    """One is done, one fails, and one is killed from outside."""
    pytest.importorskip(package)
    recorded = generators.uniform(scene_named("pendulum"), samples=50)
    for name in ("good", "killed"):
        schema.save(tmp_path / f"{name}.npz", recorded)
    np.savez(tmp_path / "bad.npz", nothing=1.0)
    files = ",".join(str(tmp_path / f"{name}.npz") for name in ("good", "bad", "killed"))
    killer = threading.Thread(target=kill_as_it_begins, args=(tmp_path / "sweep" / "jobs" / "0002",))
    killer.start()
    with pytest.raises(SystemExit) as stop:
        command(
            sweep, "--command", "check_data", "--grid", f"data={files}", "--fixed", "figures=no", "--where", where,
            "--jobs", "2", "--out", tmp_path / "sweep",
        )  # fmt: skip
    killer.join()
    assert stop.value.code == 1
    done, failed, killed = (status_of(tmp_path / "sweep" / "jobs" / f"{number:04}") for number in range(3))
    assert done.state == "done" and failed.state == "failed" and killed.state == "killed"
    assert "bad.npz" in failed.line
    assert "warnings" in (tmp_path / "sweep" / "table.csv").read_text()
    assert f"0002 {killed.state}: {killed.line}" in capsys.readouterr().out
