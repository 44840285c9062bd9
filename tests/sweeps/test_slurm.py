"""An array of jobs on a cluster that is pretended by four programs on the PATH: what it is told, and what it says."""

import json
import pickletools

import pytest
from calls import command, refused

from dln_jax.commands import sweep
from dln_jax.sweeps import engines, slurm
from dln_jax.sweeps.status import Status, status_of, write_status
from dln_jax.sweeps.work import Work

pytest.importorskip("submitit")
PROGRAMS = {
    "sbatch": 'cat "$1" >> FOLDER/scripts; echo "Submitted batch job 7"',
    "sacct": 'echo "JobID|State|NodeList"; cat FOLDER/states',
    "scancel": 'echo "$@" >> FOLDER/cancelled',
    "srun": "exit 1",
}


@pytest.fixture
def cluster(tmp_path, monkeypatch):
    """A folder of programs, in which what the array is and what was cancelled is written."""
    folder = tmp_path / "cluster"
    folder.mkdir()
    for name, text in PROGRAMS.items():
        (folder / name).write_text(f"#!/bin/sh\n{text.replace('FOLDER', str(folder))}\n")
        (folder / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}:/usr/bin:/bin")
    monkeypatch.setenv("SUBMITIT_LOG_LEVEL", "NOCONFIG")
    monkeypatch.setattr(engines, "SECONDS_BETWEEN_LOOKS", 0.01)
    import submitit

    submitit.SlurmJob.watcher.clear()
    return folder


GRID = ("--grid", "width=4,8,16", "--where", "slurm")


def test_an_array_is_submitted_and_what_slurm_ends_is_said(cluster, tmp_path, capsys):
    (cluster / "states").write_text("7_0|OUT_OF_MEMORY|a\n7_1|TIMEOUT|a\n7_2|CANCELLED by 0|a\n")
    with pytest.raises(SystemExit) as stop:
        command(
            sweep, *GRID, "--slurm", "partition=gpu time=30 gpus_per_node=1", "--jobs", "2", "--out", tmp_path / "s"
        )
    said = capsys.readouterr().out
    assert stop.value.code == 1 and "0000 killed: did not start (OUT_OF_MEMORY)" in said and "(TIMEOUT)" in said
    script = (cluster / "scripts").read_text()
    for line in (
        "--array=0-2%2",
        "--partition=gpu",
        "--time=30",
        "--gpus-per-node=1",
        "--job-name=s",
        "--open-mode=append",
    ):
        assert f"#SBATCH {line}\n" in script
    assert "#SBATCH --signal=USR2@" in script and "submitit.core._submit" in script and script.count("srun") == 1
    # What is pickled are names, and the path of the job's file.
    for number in range(3):
        pickled = (tmp_path / "s" / "submitit" / f"7_{number}_submitted.pkl").read_bytes()
        strings = [value for code, value, _ in pickletools.genops(pickled) if "UNICODE" in code.name]
        assert (
            "dln_jax.sweeps.work" in strings and str(tmp_path / "s" / "jobs" / f"{number:04}" / "job.json") in strings
        )
        assert len(pickled) < 1000


def test_a_resumed_sweep_finds_its_jobs_in_the_queue(cluster, tmp_path):
    jobs = tmp_path / "s" / "jobs"
    (cluster / "states").write_text("7_0|PENDING|a\n7_1|RUNNING|a\n7_2|FAILED|a\n")
    paths = [jobs / f"{number:04}" / "job.json" for number in range(3)]
    for path in paths:
        path.parent.mkdir(parents=True)
    (tmp_path / "s" / slurm.IDS).write_text(json.dumps({"0000": "7_0", "0001": "7_1", "0002": "7_2"}))
    with slurm.slurm(tmp_path / "s", 3, None, "") as engine:
        handles = engine.start(paths)
        assert [job.job_id for _, job in handles] == ["7_0", "7_1", "7"]
        assert (cluster / "scripts").read_text().count("srun") == 1  # the one that is gone
        assert engine.over(handles[0]) is None
        (paths[0].parent / "run" / "figures").mkdir(parents=True)
        write_status(paths[0].parent, Status("done", run="run"))
        assert engine.over(handles[0]) == ""
        engine.stop(handles[1:])
    assert (cluster / "cancelled").read_text() == "7_1 7\n"


def test_a_job_that_is_queued_again_is_the_same_job():
    queued = Work().checkpoint("/a/job.json")
    assert type(queued.function) is Work and queued.args == ("/a/job.json",) and not queued.kwargs


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("partion=gpu", "did you mean partition?"),
        ("time", "no NAME=VALUE"),
        ("time=5 time=6", "names time twice"),
        ("time=1-00:00", "whole minutes"),
    ],
)
def test_options_of_sbatch_are_checked(cluster, tmp_path, capsys, options, message):
    assert message in refused(capsys, sweep, *GRID, "--slurm", options, "--out", tmp_path / "s")
    assert not (tmp_path / "s").exists()


def test_an_array_has_an_end(cluster, tmp_path, capsys):
    line = refused(capsys, sweep, "--grid", "seed=0:1001", "--where", "slurm", "--out", tmp_path / "s")
    assert "1001 jobs for one Slurm array" in line and not (tmp_path / "s").exists()


def test_what_sbatch_refuses_is_one_line(cluster, tmp_path, capsys):
    (cluster / "sbatch").write_text("#!/bin/sh\necho 'invalid partition specified: gpu' >&2; exit 1\n")
    line = refused(capsys, sweep, *GRID, "--out", tmp_path / "s")
    assert "invalid partition specified: gpu" in line


def test_a_status_survives_its_file(tmp_path):
    write_status(tmp_path, Status("failed", "why", 2, "run", 1.5, "host", 7))
    assert status_of(tmp_path) == Status("failed", "why", 2, "run", 1.5, "host", 7)
