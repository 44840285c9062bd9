"""Arrays of jobs on a Slurm cluster that four programs on the PATH simulate."""

import pytest
from calls import assert_refused, exit_status, refused

from dln_jax.commands import sweep
from dln_jax.commands.sweeps.executors import Requeued
from dln_jax.commands.sweeps.jobs import Job, run_job

PROGRAMS = {
    "sbatch": 'cat "$1" >> FOLDER/scripts; echo "Submitted batch job 7"',
    "sacct": 'echo "JobID|State|NodeList"; cat FOLDER/states',
    "scancel": 'echo "$@" >> FOLDER/cancelled',
    "srun": "exit 1",
}


@pytest.fixture
def cluster(tmp_path, monkeypatch):
    """A folder of programs, which write there the submitted script and the cancelled jobs."""
    folder = tmp_path / "cluster"
    folder.mkdir()
    for name, text in PROGRAMS.items():
        (folder / name).write_text(f"#!/bin/sh\n{text.replace('FOLDER', str(folder))}\n")
        (folder / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}:/usr/bin:/bin")
    monkeypatch.setenv("SUBMITIT_LOG_LEVEL", "NOCONFIG")
    import submitit

    submitit.SlurmJob.watcher.clear()
    return folder


GRID = "--grid width=4,8,16 --where slurm"


def test_array_is_submitted_and_slurm_s_reasons_are_printed(cluster, tmp_path, capsys):
    (cluster / "states").write_text("7_0|OUT_OF_MEMORY|a\n7_1|TIMEOUT|a\n7_2|CANCELLED by 0|a\n")
    asked = ("--slurm", "partition=gpu time=30 gpus_per_node=1", "--jobs 2 --out", tmp_path / "s")
    status = exit_status(sweep, GRID, *asked)
    text = capsys.readouterr().out
    assert status == 1 and "0000 killed: did not start (OUT_OF_MEMORY)" in text and "(TIMEOUT)" in text
    script = (cluster / "scripts").read_text()
    options = "array=0-2%2 partition=gpu time=30 gpus-per-node=1 job-name=s open-mode=append"
    assert all(f"#SBATCH --{option}\n" in script for option in options.split())
    assert "#SBATCH --signal=USR2@" in script and "submitit.core._submit" in script and script.count("srun") == 1
    assert not list((tmp_path / "s/submitit").glob("*.pkl")), "pickles are left"


def test_a_job_that_is_queued_again_is_the_same_job(tmp_path):
    job = Job(tmp_path, "train_delan", ("--width=4",), {"width": "4"}, resumes=True, directory=tmp_path)
    queued = Requeued(run_job).checkpoint(job)
    assert queued.function == Requeued(run_job) and queued.args == (job,) and not queued.kwargs


def test_options_of_sbatch_are_checked(cluster, tmp_path, capsys):
    rows = [
        ("--slurm partion=gpu", "partion"),
        ("--slurm time", "expected NAME=VALUE"),
        ("--slurm", "time=5 time=6", "names 'time' twice"),
        ("--slurm time=1-00:00", "whole minutes"),
        # Larger than Slurm's arrays.
        ("--grid seed=0:1001", "1001 jobs for one Slurm array"),
    ]
    assert_refused(capsys, sweep, rows, GRID, out=tmp_path / "s")
    (cluster / "sbatch").write_text("#!/bin/sh\necho 'invalid partition specified: gpu' >&2; exit 1\n")
    assert "invalid partition specified: gpu" in refused(capsys, sweep, GRID, "--out", tmp_path / "s")
