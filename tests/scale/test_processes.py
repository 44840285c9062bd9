"""Commands in several processes: results, refusals, and the loss of a process."""

import os
import signal
import socket
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from calls import one_line
from interpreters import Program, interpreters
from safetensors.numpy import load_file

from dln_jax.scale import membership

TINY = '''
"""A command that iterates a map; every step needs all devices, and a process may be lost."""
import dataclasses, os, signal, subprocess, sys
import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.options import Resumable, Scaled
from dln_jax.runs.progress import progress
from dln_jax.runs.running import run
from dln_jax.runs.folder import command_folder
from dln_jax.runs.devices import mesh_of
from dln_jax.scale import of_first_process, shard, spread
from dln_jax.types import InputError
from dln_jax.zoo.parameter_files import load_tree, save_tree

LOST, JOINING = os.environ.get("LOST", ""), int(os.environ.get("JOINING", "60"))

@dataclasses.dataclass(frozen=True)
class Arguments(Resumable, Scaled):
    """Options of the iteration."""
    seed: int = 0
    """Unused."""

def lose(process):
    who, _, how = LOST.partition(" ")
    if who != str(process):
        return
    if how == "error":
        raise InputError("the disk is full")
    if how == "SIGSTOP":
        subprocess.Popen(["sh", "-c", f"sleep 30; kill -9 {os.getpid()}"])  # nothing else ends one that is stopped
    os.kill(os.getpid(), getattr(signal, how))

def main(options):
    mesh = mesh_of(options)
    places = shard(np.arange(4.0), mesh)
    step = jax.jit(spread(lambda state, places: jnp.cos(3.0 * jnp.sum(state) + places), mesh))
    with command_folder(options, "tiny") as folder, progress(8) as show:
        print("I am the first")
        state = {"done": np.array(0), "places": np.zeros(4)}
        if options.resume:
            state = load_tree(folder, "state", state)
        for done in range(int(state["done"]) + 1, 9):
            state = {"done": np.array(done), "places": np.asarray(step(np.asarray(state["places"]), places))}
            save_tree(folder, "state", state, {}, number=done)
            show(done, "")
            if done == 4:
                lose(options.process_id or 0)
        assert of_first_process(float(jax.process_index()), mesh) == 0.0
        devices = np.array(mesh.size if mesh else 1)
        save_tree(folder, "result", {**state, "devices": devices}, {})

code = 0
try:
    run(main, Arguments, prog="tiny", joining=JOINING)
except SystemExit as stop:
    code = stop.code
if code == 0 and jax.process_count() > 1:
    jax.distributed.shutdown()
sys.stdout.flush()
os._exit(code)  # a second sooner
'''


class Ended(NamedTuple):
    """Results of processes that were started together."""

    codes: tuple[int, ...]
    out: list[str]
    err: list[str]
    folder: Path


@pytest.fixture(scope="module")
def run_programs():
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("JAX_", "SLURM_"))}
    with interpreters(environment) as run:
        yield run


@pytest.fixture(scope="module")
def run_tiny(run_programs, tmp_path_factory):
    """A function that runs the command once for each list of processes, all beside each other.

    A run is a list of (options, environment), an environment of all of them, and maybe the folder of an earlier one.
    """
    path = tmp_path_factory.mktemp("tiny") / "tiny.py"
    path.write_text(TINY)
    own = {key: value for key, value in os.environ.items() if not key.startswith("SLURM_")}

    def run(runs):
        runs = [
            (processes, shared, *(folder or [tmp_path_factory.mktemp("run")])) for processes, shared, *folder in runs
        ]
        programs = [
            Program(path, folder, {**own, **shared, **more}, ("--out", "run", *options))
            for processes, shared, folder in runs
            for options, more in processes
        ]
        results = iter(run_programs(path.parent, *programs))
        ended = []
        for processes, _, folder in runs:
            codes, out, err = zip(*(next(results) for _ in processes), strict=True)
            ended.append(Ended(codes, list(out), list(err), folder))
        return ended

    return run


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def pair(*more, first=(), second=(), host="127.0.0.1", port=None):
    """Arguments of two processes."""
    both = ("--processes", "2", "--coordinator", f"{host}:{port or free_port()}", *more)
    return [((*both, "--process-id", "0", *first), {}), ((*both, "--process-id", "1", *second), {})]


def slurm_pair():
    """Environments that Slurm gives two tasks of a step, on this host."""
    step = {"SLURM_JOB_ID": str(free_port()), "SLURM_STEP_NUM_TASKS": "2", "SLURM_NTASKS": "2"}
    step |= {"SLURM_STEP_NODELIST": "localhost"}
    return [(("--devices", "2"), {**step, "SLURM_PROCID": str(k), "SLURM_LOCALID": str(k)}) for k in range(2)]


LOSSES = {"1 SIGKILL": (3, -9), "0 SIGKILL": (-9, 3), "1 error": (3, 2), "1 SIGSTOP": (-signal.SIGABRT, -9)}
"""Statuses of two processes by how one of them is lost."""


@pytest.fixture(scope="module")
def trained(run_tiny):
    """One process, and two with one that is killed."""
    return dict(zip(("alone", "1 SIGKILL"), run_tiny([([((), {})], {}), (pair(), {"LOST": "1 SIGKILL"})]), strict=True))


@pytest.fixture(scope="module")
def trained_more(run_tiny, trained):
    """Two processes by Slurm, and two with one that is lost in other ways."""
    ways = [how for how in LOSSES if how not in trained]
    runs = [(slurm_pair(), {}), *((pair(), {"LOST": how}) for how in ways)]
    return {**trained, **dict(zip(("slurm", *ways), run_tiny(runs), strict=True))}


def assert_same_result(started, alone, devices=1):
    """All that ran to its end is bit for bit what one process on one device gives."""
    assert set(started.codes) == {0} and not any(started.err)
    ours, theirs = (load_file(ended.folder / "run" / "result.safetensors") for ended in (started, alone))
    np.testing.assert_array_equal(ours["places"], theirs["places"])
    assert (ours["done"], ours["devices"], theirs["devices"]) == (8, devices, 1)


def test_two_processes_give_what_one_gives_and_the_first_alone_prints(trained_more):
    assert_same_result(trained_more["slurm"], trained_more["alone"], devices=4)
    first, second = trained_more["slurm"].out
    assert first.startswith("2 processes, ") and "I am the first" in first and "Gloo" not in first and not second


def assert_ended_by_loss(result, how):
    """With a line that says how to go on, unless JAX's own runtime is the first to notice, and aborts."""
    expected = LOSSES[how]
    remaining = 1 - expected.index(-9 if -9 in expected else 2)
    code, err = result.codes[remaining], result.err[remaining]
    assert result.codes[1 - remaining] == expected[1 - remaining]
    if how in ("1 SIGKILL", "1 error"):
        assert code == 3 and err.startswith("error: another process is lost") and len(err.splitlines()) == 1
        assert "run with --resume in all processes" in err
    else:
        assert code in (3, -signal.SIGABRT) and "another" in err


def test_a_killed_process_ends_the_other_and_the_run_continues_as_if_unbroken(run_tiny, trained):
    broken = trained["1 SIGKILL"]
    assert_ended_by_loss(broken, "1 SIGKILL")
    assert not (broken.folder / "run" / "result.json").exists()
    (result,) = run_tiny([(pair("--resume"), {}, broken.folder)])
    assert_same_result(result, trained["alone"], devices=2)
    assert "process" not in (broken.folder / "run" / "config.json").read_text()


@pytest.mark.slow
def test_a_lost_process_ends_the_other_and_the_run_continues_in_one_process_or_without_its_first(
    run_tiny, trained_more
):
    for how in LOSSES:
        assert_ended_by_loss(trained_more[how], how)
    ways = {"0 SIGKILL": pair("--resume"), "1 SIGSTOP": [(("--resume",), {})]}
    results = run_tiny([(processes, {}, trained_more[how].folder) for how, processes in ways.items()])
    for result, processes in zip(results, ways.values(), strict=True):
        assert_same_result(result, trained_more["alone"], devices=len(processes))


def test_processes_that_cannot_be_one_program_end_with_one_line_each(run_tiny):
    hurried = {"JOINING": "5"}
    with socket.socket() as taken:
        taken.bind(("", 0))
        taken.listen()
        refused = [
            (pair(first=("--seed", "1"), second=("--seed", "2")), {}, "--seed differs between process 0 and process 1"),
            (pair(second=("--devices", "3")), {}, "--devices: process 0 has 1, process 1 has 3"),
            ([pair()[0]] * 2, hurried, "of --coordinator is not free"),
            (pair()[:1], hurried, "the 2 processes did not meet at 127.0.0.1:"),
            (pair(host="localhost", port=taken.getsockname()[1]), hurried, "of --coordinator is not free"),
            (pair(host="no-such-host.invalid"), hurried, "cannot reach no-such-host.invalid"),
        ]
        results = run_tiny([(processes, shared) for processes, shared, _ in refused])
    for (*_, message), result in zip(refused, results, strict=True):
        lines = [err.splitlines() for err in result.err]
        assert set(result.codes) == {2}, message
        assert all(len(text) == 1 and text[0].startswith("error: ") for text in lines), message
        assert any(message in err for err in result.err), message
        assert not list(result.folder.iterdir()), f"{message}: something is left"


def test_devices_of_one_process_share_batches(run_programs, tmp_path):
    path = Path(__file__).with_name("on_four_devices.py")
    (result,) = run_programs(tmp_path, Program(path, tmp_path, dict(os.environ)))
    assert (result.returncode, result.stderr) == (0, "")


TASK = {"SLURM_STEP_NUM_TASKS": "4"}
REFUSED = [
    (2, "node1:\uff15\uff10\uff10\uff10", 0, "expected host:port, such as node1:61440"),
    (2, "n\u00f6de:5000", 0, "expected host:port, such as node1:61440"),
    (2, None, None, "--coordinator and --process-id missing beside --processes"),
    (None, "node1:5000", None, "--processes and --process-id missing beside --coordinator"),
    (2, "node1:5000", None, "--process-id missing beside --processes and --coordinator"),
    (None, None, 0, "missing beside --process-id"),
    (1, "node1:5000", 0, "leave out --coordinator"),
    (0, None, None, "expected a positive whole number"),
    (2, "node1:5000", 2, "expected 0 to 1"),
    (2, "node1:5000", -1, "expected 0 to 1"),
    *((2, address, 0, "expected host:port") for address in ("node1", "node1:70000", "node1:0", "::1:5000")),
    (2, "http://node1:5000", 0, "expected host:port"),
]


def test_options_are_a_membership_and_go_before_a_cluster():
    assert membership(2, "node1:5000", 1, TASK) == ("node1:5000", 2, 1)
    assert membership(2, "[fe80::1]:5000", 1, {}) == ("[fe80::1]:5000", 2, 1)
    assert membership(None, None, None, TASK) == (None, None, None)
    assert membership(None, None, None, {}) is None
    assert membership(1, None, None, TASK) is None
    assert membership(None, None, None, {"SLURM_STEP_NUM_TASKS": "1"}) is None
    for *options, message in REFUSED:
        with one_line(message):
            membership(*options, {})
