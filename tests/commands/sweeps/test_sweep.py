"""Sweeps from the shell: states of jobs, choice of the best job, and --resume of the jobs that are not done."""

import contextlib
import json
import os
import shlex
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from calls import assert_refused, command, exit_status, json_of, one_line, refused

from dln_jax.commands import sweep
from dln_jax.commands.sweeps import executors
from dln_jax.commands.sweeps.jobs import Job, Status, run_job, status_of
from dln_jax.commands.sweeps.results import compare, write_tables
from dln_jax.data import schema
from dln_jax.scenes.datasets import generators
from dln_jax.scenes.registry import scene_named

WIDTHS = {"2": 3e-3, "4": 1e-4, "8": 2e-4}
"""Validation errors of simulated trainings by width; seeds add to them."""


def trained(job, resumed):
    """Simulates a run of a job, whose test error is smallest where its validation error is largest."""
    width, seed = job.values["width"], int(job.values["seed"])
    before = status_of(job.folder)
    if before.attempt and not job.resumes:
        before = before._replace(run=f"run-{before.attempt + 1}")
    run = job.folder / before.run
    run.mkdir(exist_ok=True)
    (run / "config.json").write_text("{}")
    status = Status("running", attempt=before.attempt + 1, run=before.run)
    if width == "8" and seed == 1 and not resumed:
        return status._replace(state="failed", line="the loss stopped being finite")
    if width == "2" and seed == 1 and not resumed:
        return status
    validation = WIDTHS[width] * (1 + seed)
    metrics = {"validation_error": validation, "torque_mse": 1e-7 / validation, "train_seconds": 1.0 + seed}
    (run / "metrics.json").write_text(json.dumps(metrics))
    return status._replace(state="done")


def use(monkeypatch, submit):
    """Lets the command submit each job to this function in place of processes."""
    together = contextlib.nullcontext(lambda function, jobs: [submit(function, job) for job in jobs])
    monkeypatch.setattr(executors, "here", lambda *_: together)


@pytest.fixture
def executor(monkeypatch):
    """Simulates jobs one after the other; one fails at its first attempt, and one is killed as it begins."""
    begun = []

    def submit(function, job):
        assert function is run_job
        begun.append(job.values)
        status = trained(job, resumed=begun.count(job.values) > 1)
        (job.folder / "status.json").write_text(json.dumps(status._asdict()))
        return Mock(state="OUT_OF_MEMORY")

    use(monkeypatch, submit)
    return begun


def test_unknown_metrics_are_refused_and_jobs_are_kept(tmp_path, executor, capfd):
    for count, option in ((2, "metric"), (4, "error")):
        out = tmp_path / option
        status = exit_status(sweep, "--grid", "width=4 seed=0:2", "--out", out, f"--{option}", "torque_msee")
        assert status == 2 and not (out / "table.csv").exists()
        expected = f"--{option}: no job has the metric 'torque_msee'; choose from torque_mse, train_seconds, valid"
        assert expected in capfd.readouterr().err
        command(sweep, "--out", out, "--resume", f"--{option}", "torque_mse")
        assert len(executor) == count and (out / "table.csv").is_file()


def test_a_resumed_sweep_runs_only_unfinished_jobs(tmp_path, executor, capfd):
    out = tmp_path / "sweep"
    status = exit_status(sweep, "--grid", "width=2,4,8 seed=0:3", "--fixed steps=3 --out", out)
    text = capfd.readouterr().out
    assert status == 1 and len(executor) == 9
    results = json_of(out / "sweep.json")
    states = [job["state"] for job in results["jobs"]]
    assert states == ["done", "killed", *["done"] * 5, "failed", "done"]
    assert "0001 killed: ended without a status (OUT_OF_MEMORY)" in text
    assert "0007 failed: the loss stopped being finite" in text
    assert (out / "sweep.png").read_bytes().startswith(b"\x89PNG")
    # The job with the best validation error has the worst test error.
    (best,) = [job["values"] for job in results["jobs"] if job["best"]]
    assert best == {"width": "4", "seed": "0"}
    # Medians over seeds, by hand.
    groups = {group["values"]["width"]: group for group in results["groups"]}
    assert groups["4"]["medians"]["validation_error"] == pytest.approx(2e-4)
    assert groups["4"]["worst"]["train_seconds"] == 3.0 and groups["2"]["done"] == 2
    assert groups["2"]["medians"]["validation_error"] == pytest.approx(np.median([3e-3, 9e-3]))

    command(sweep, "--out", out, "--resume --best largest")
    assert executor[9:] == [{"width": "2", "seed": "1"}, {"width": "8", "seed": "1"}]
    results = json_of(out / "sweep.json")
    assert {job["state"] for job in results["jobs"]} == {"done"}
    (best,) = [job for job in results["jobs"] if job["best"]]
    assert best["values"] == {"width": "2", "seed": "2"}
    # Jobs that had begun were continued in their folders.
    assert status_of(out / "jobs/0007")[:4] == ("done", "", 2, "run")
    command(sweep, "--out", out, "--resume")
    assert len(executor) == 11


def test_any_scheduler_may_run_the_lines_of_later(tmp_path, executor, capsys):
    out = tmp_path / "sweep"
    command(sweep, "--grid", "width=2,4 seed=0", "--where later --out", out)
    assert "the command lines of 2 jobs" in capsys.readouterr().out and not (out / "sweep.json").exists()
    lines = (out / "jobs.sh").read_text().splitlines()
    for width, line in zip(("2", "4"), map(shlex.split, lines), strict=True):
        assert line[1:4] == ["-m", "dln_jax", "train_delan"] and f"--width={width}" in line
        run = Path(line[-1].removeprefix("--out="))
        run.mkdir(parents=True)
        (run / "metrics.json").write_text(json.dumps({"validation_error": WIDTHS[width]}))
    command(sweep, "--out", out, "--resume --where here")
    assert not executor and "best by validation_error: width=4" in capsys.readouterr().out


def test_failed_job_is_repeated_in_another_folder_and_finished_job_is_not(tmp_path):
    job = Job(tmp_path / "0", "check_data", ("--data=none.npz",), {}, resumes=False, directory=tmp_path)
    run, stored = job.folder / "run", job.folder / "status.json"
    run.mkdir(parents=True)  # made by another program
    stored.write_text(json.dumps(Status("killed", attempt=1)._asdict()))
    run_job(job)
    status = status_of(job.folder)
    assert (status.state, status.attempt, status.run) == ("failed", 2, "run-2")
    assert "none.npz" in status.line and "none.npz" in (job.folder / "output.txt").read_text()
    stored.unlink()
    (run / "metrics.json").write_text("{}")
    run_job(job)
    assert not stored.exists()


def test_a_table_holds_no_formula_and_no_metric_that_is_none(tmp_path):
    jobs = [Job(tmp_path / name, "train_delan", (), {"width": "=1+1", "shift": "-1"}, True, tmp_path) for name in "abc"]
    for job, metrics in zip(jobs, ('{"torque_mse": 1.0}', '{"=cmd": 1.0}', '{"torque_mse": "=1"}'), strict=True):
        (job.folder / "run").mkdir(parents=True)
        (job.folder / "run/metrics.json").write_text(metrics)
    results = compare(jobs)
    assert [row["state"] for row in results["jobs"]] == ["done", "done", "failed"]
    write_tables(tmp_path, results)
    text = (tmp_path / "table.csv").read_text()
    assert text.count("'=1+1,-1") == 3 and ",=" not in text


def test_damaged_status_is_refused(tmp_path):
    for damage in (
        '{"run": "../../X"}',
        '{"run": "/tmp/X"}',
        '{"run": 5}',
        '{"attempt": "x"}',
        '{"attempt": -1}',
        '{"state": "happy"}',
        '{"seconds": "few"}',
    ):
        status = {**Status("done", attempt=1)._asdict(), **json.loads(damage)}
        (tmp_path / "status.json").write_text(json.dumps(status))
        with one_line(r"status\.json"):
            status_of(tmp_path)


def test_finished_job_whose_run_is_gone_is_repeated(tmp_path, executor, capsys):
    out = tmp_path / "sweep"
    command(sweep, "--grid", "width=4 seed=0", "--out", out)
    line = refused(capsys, sweep, "--grid", "width=2 seed=0", "--out", out, "--resume")
    assert "was started with grid = width=4 seed=0" in line
    for run in (out / "jobs/0000/run").iterdir():
        run.unlink()
    command(sweep, "--out", out, "--resume")
    assert len(executor) == 2


def test_every_problem_has_its_best_job(tmp_path, executor):
    for name in "ab":
        (tmp_path / name).touch()
    command(sweep, "--grid", f"data={tmp_path}/a,{tmp_path}/b width=2,4 seed=0", "--out", tmp_path / "s")
    jobs = json_of(tmp_path / "s/sweep.json")["jobs"]
    assert [job["values"]["width"] for job in jobs if job["best"]] == ["4", "4"]


def test_an_interrupt_cancels_the_jobs(tmp_path, monkeypatch, capsys):
    future = Mock()
    future.done.side_effect = KeyboardInterrupt
    use(monkeypatch, lambda function, job: future)
    status = exit_status(sweep, "--grid", "width=2,4,8 seed=0", "--out", tmp_path / "s")
    assert status == 130 and f"continue with: sweep --out {tmp_path}/s --resume" in capsys.readouterr().err
    assert future.cancel.call_count == 3


def test_an_interrupt_ends_the_processes_of_this_machine(tmp_path):
    """Jobs that have not begun never start."""
    first, second = (Job(tmp_path / name, "train_delan", (), {}, resumes=True, directory=tmp_path) for name in "ab")
    with pytest.raises(KeyboardInterrupt), executors.here(1, 0) as submit:
        futures = submit(run_job, (first, second))
        until = time.monotonic() + 60
        while status_of(first.folder).state != "running" and time.monotonic() < until:
            time.sleep(0.01)
        raise KeyboardInterrupt
    assert futures[0].done() and futures[1].cancelled() and not second.folder.exists()
    assert status_of(first.folder)[:2] == ("killed", "interrupted")


def test_jobs_get_the_gpus_that_the_user_has_made_visible(monkeypatch, tmp_path):
    together = threading.Barrier(2, timeout=60)
    jobs = [Job(tmp_path / name, "train_delan", (), {}, resumes=True, directory=tmp_path) for name in "ab"]
    for visible, expected in (("", {"0", "1"}), ("2,5,7", {"2", "5"})):
        devices = set()

        def wait_for_the_other(job, environment, interrupt, devices=devices):
            devices.add(environment["CUDA_VISIBLE_DEVICES"])
            together.wait()  # both run at once, each with a GPU of its own

        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
        with executors.here(2, 2) as submit:
            for future in submit(wait_for_the_other, jobs):
                future.result()
        assert devices == expected
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3")
    with one_line("names 1 of them: 3"), executors.here(2, 2):
        pass


def test_mistakes_are_one_line_and_leave_nothing(tmp_path, capsys, monkeypatch):
    rows = {
        "--grid width=a": "--width must be a whole number",
        "--jobs 1": "--grid names no option",
        "--command train_delen --grid width=8": "did you mean train_delan?",
        "--command sweep --grid width=8": "there is no 'sweep'",
        "--command make_data --grid seed=0:2": "make_data",
        "--grid width=8 --over seed": "'seed' is unknown",
        "--grid width=8 --jobs 0": "jobs is 0",
        "--grid width=8 --jobs 4 --gpus 2": "each job needs its own GPU",
        "--grid width=8 --where slurm": "no sbatch on the PATH",
    }
    assert_refused(capsys, sweep, rows.items(), out=tmp_path / "sweep")
    # A missing executor is named with its extra.
    for package in ("submitit", "ray"):
        monkeypatch.setitem(sys.modules, package, None)
    rows = {
        "--grid width=8 --where slurm": "pip install 'dln-jax[sweep]'",
        "--grid width=8 --where ray": "pip install 'dln-jax[ray]'",
    }
    assert_refused(capsys, sweep, rows.items(), out=tmp_path / "sweep")


def kill_as_it_begins(job):
    """SIGKILL to a job's command as soon as it runs."""
    until = time.monotonic() + 60
    processes = ""
    while time.monotonic() < until and not processes:
        processes = subprocess.run(["pgrep", "-f", f"out={job}"], capture_output=True, text=True).stdout
        time.sleep(0.01)
    os.kill(int(processes.split()[0]), signal.SIGKILL)


@pytest.mark.parametrize(("where", "package"), [("here", "dln_jax"), ("ray", "ray")])
def test_jobs_in_processes_of_their_own(where, package, tmp_path, capsys):
    """One is done, one fails, and one is killed by a signal."""
    pytest.importorskip(package, reason="jobs by ray need the extra [ray]")
    recorded = generators.uniform(scene_named("pendulum"), samples=50)
    for name in ("good", "killed"):
        schema.save(tmp_path / f"{name}.npz", recorded)
    np.savez(tmp_path / "bad.npz", nothing=1.0)
    files = ",".join(str(tmp_path / f"{name}.npz") for name in ("good", "bad", "killed"))
    killer = threading.Thread(target=kill_as_it_begins, args=(tmp_path / "sweep/jobs/0002",))
    killer.start()
    fixed = ("--fixed figures=no --jobs 2 --where", where, "--out", tmp_path / "sweep")
    status = exit_status(sweep, "--command check_data --grid", f"data={files}", *fixed)
    killer.join()
    assert status == 1
    done, failed, killed = (status_of(tmp_path / f"sweep/jobs/{number:04}") for number in range(3))
    assert done.state == "done" and failed.state == "failed" and killed.state == "killed"
    assert "bad.npz" in failed.line
    assert "warnings" in (tmp_path / "sweep/table.csv").read_text()
    assert f"0002 {killed.state}: {killed.line}" in capsys.readouterr().out
