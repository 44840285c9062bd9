"""Commands in several processes: results, refusals, and the loss of a process."""

import os
import signal
import socket
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from interpreters import Program, interpreters
from safetensors.numpy import load_file

from dln_jax.scale.processes import Membership, membership
from dln_jax.types import InputError

TINY = '''
"""A command that iterates a map; every step needs all devices, and a process may be lost."""
import dataclasses, os, signal, subprocess, sys
import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.cli.options import Resumable, Scaled
from dln_jax.cli.progress import progress
from dln_jax.cli.running import run
from dln_jax.cli.stored_arguments import command_folder
from dln_jax.cli.scaled import mesh_of
from dln_jax.scale.mesh import of_first_process, shard, spread
from dln_jax.types import InputError
from dln_jax.zoo.parameter_files import load_tree, save_tree

LOST, JOINING = os.environ.get("LOST", ""), int(os.environ.get("JOINING", "60"))

@dataclasses.dataclass(frozen=True)
class Arguments(Resumable, Scaled):
    """What to iterate."""
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

MESH = Path(__file__).with_name("on_four_devices.py")


class Ended(NamedTuple):
    """Results of processes that were started together."""

    codes: tuple[int, ...]
    out: list[str]
    err: list[str]
    folder: Path

    @property
    def result(self):
        return load_file(self.folder / "run" / "result.safetensors")


@pytest.fixture(scope="module")
def run_programs():
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("JAX_", "SLURM_"))}
    with interpreters(environment) as run:
        yield run


@pytest.fixture(scope="module")
def run_tiny(run_programs, tmp_path_factory):
    """A function that runs the command once for each list of processes, all beside each other."""
    path = tmp_path_factory.mktemp("tiny") / "tiny.py"
    path.write_text(TINY)

    def run(*runs):
        programs, folders = [], []
        for processes, shared, folder in runs:
            folder = folder or tmp_path_factory.mktemp("run")
            folders.append(folder)
            for options, more in processes:
                environment = {key: value for key, value in os.environ.items() if not key.startswith("SLURM_")}
                programs.append(Program(path, folder, {**environment, **shared, **more}, ("--out", "run", *options)))
        results = iter(run_programs(path.parent, *programs))
        ended_runs = []
        for (processes, _, _), folder in zip(runs, folders, strict=True):
            ended = [next(results) for _ in processes]
            codes = tuple(result.returncode for result in ended)
            texts = ([getattr(result, name) for result in ended] for name in ("stdout", "stderr"))
            ended_runs.append(Ended(codes, *texts, folder))
        return ended_runs

    return run


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def pair(*more, first=(), second=(), host="127.0.0.1", port=None):
    """Arguments of two processes."""
    both = ("--processes", "2", "--coordinator", f"{host}:{port or free_port()}", *more)
    return [((*both, "--process-id", "0", *first), {}), ((*both, "--process-id", "1", *second), {})]


def slurm_pair(*more):
    """Environments that Slurm gives two tasks of a step, on this host."""
    step = {"SLURM_JOB_ID": str(free_port()), "SLURM_STEP_NUM_TASKS": "2", "SLURM_NTASKS": "2"}
    step |= {"SLURM_STEP_NODELIST": "localhost"}
    return [(more, {**step, "SLURM_PROCID": str(k), "SLURM_LOCALID": str(k)}) for k in range(2)]


RUNS = {"alone": lambda: [((), {})], "two": pair, "1 SIGKILL": pair}
LOST = ("1 SIGSTOP", "0 SIGKILL", "1 error")
MORE_RUNS = {"slurm": lambda: slurm_pair("--devices", "2"), **dict.fromkeys(LOST, pair)}
"""Processes by how they are started, or by how one of them is lost."""


def started(run_tiny, runs):
    losses = {how: {"LOST": how} if how[0].isdigit() else {} for how in runs}
    return dict(zip(runs, run_tiny(*((runs[how](), losses[how], None) for how in runs)), strict=True))


@pytest.fixture(scope="module")
def trained(run_tiny):
    """One process, two, and two with one that is lost."""
    return started(run_tiny, RUNS)


@pytest.fixture(scope="module")
def trained_more(run_tiny):
    """Two processes by Slurm, and two with one that is lost in other ways."""
    return started(run_tiny, MORE_RUNS)


def assert_same_result(started, alone):
    np.testing.assert_array_equal(started.result["places"], alone.result["places"])
    assert started.result["done"] == 8


def assert_is_one_program(result, alone, devices):
    assert (result.codes, result.err) == ((0, 0), ["", ""])
    assert_same_result(result, alone)
    assert (result.result["devices"], alone.result["devices"]) == (devices, 1)
    first, second = result.out
    assert first.startswith("2 processes, ") and "I am the first" in first and "Gloo" not in first and not second


@pytest.mark.slow
def test_two_processes_give_what_one_gives_and_the_first_alone_prints(trained):
    assert_is_one_program(trained["two"], trained["alone"], devices=2)


@pytest.mark.slow
def test_tasks_of_slurm_give_what_one_process_gives(trained, trained_more):
    assert_is_one_program(trained_more["slurm"], trained["alone"], devices=4)


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


LOSSES = {"1 SIGKILL": (3, -9), "0 SIGKILL": (-9, 3), "1 error": (3, 2), "1 SIGSTOP": (-signal.SIGABRT, -9)}


def test_a_killed_process_ends_the_other(trained):
    assert_ended_by_loss(trained["1 SIGKILL"], "1 SIGKILL")


@pytest.mark.slow
@pytest.mark.parametrize("how", LOST)
def test_a_lost_process_ends_the_other(trained_more, how):
    assert_ended_by_loss(trained_more[how], how)


def assert_continued(result, alone):
    assert set(result.codes) == {0} and not any(result.err)
    assert_same_result(result, alone)
    assert "process" not in (result.folder / "run" / "config.json").read_text()


def test_a_broken_run_continues_as_if_unbroken(run_tiny, trained):
    broken = trained["1 SIGKILL"].folder
    assert not (broken / "run" / "result.json").exists()
    for result in run_tiny((pair("--resume"), {}, broken)):
        assert_continued(result, trained["alone"])


@pytest.mark.slow
def test_a_broken_run_continues_in_one_process_or_without_its_first(run_tiny, trained, trained_more):
    ways = [("0 SIGKILL", pair("--resume")), ("1 SIGSTOP", [(("--resume",), {})])]
    for result in run_tiny(*((processes, {}, trained_more[how].folder) for how, processes in ways)):
        assert_continued(result, trained["alone"])


REFUSED = {
    "arguments": ("--seed differs between process 0 and process 1; it is 1", "it is 2 in this one"),
    "devices": ("--devices: process 0 has 1, process 1 has 3",) * 2,
    "twice": ("the 2 processes did not meet at 127.0.0.1:", "of --coordinator is not free"),
    "absent": ("the 2 processes did not meet at 127.0.0.1:",),
    "port": ("of --coordinator is not free", "did not meet at localhost"),
    "address": ("did not meet at no-such-host.invalid", "cannot reach no-such-host.invalid"),
}


def assert_refused(run_tiny, *reasons):
    """Pairs that cannot be one program, all beside each other, end with one line each."""
    taken = socket.socket()
    taken.bind(("", 0))
    taken.listen()
    hurried = {"JOINING": "5"}
    runs = {
        "arguments": (pair(first=("--seed", "1"), second=("--seed", "2")), {}, None),
        "devices": (pair(second=("--devices", "3")), {}, None),
        "twice": ([pair()[0]] * 2, hurried, None),
        "absent": (pair()[:1], hurried, None),
        "port": (pair(host="localhost", port=taken.getsockname()[1]), hurried, None),
        "address": (pair(host="no-such-host.invalid"), hurried, None),
    }
    with taken:
        results = run_tiny(*(runs[reason] for reason in reasons))
    for reason, result in zip(reasons, results, strict=True):
        lines = [err.splitlines() for err in result.err]
        assert set(result.codes) == {2}, reason
        assert all(len(text) == 1 and text[0].startswith("error: ") for text in lines), reason
        assert all(any(message in err for err in result.err) for message in REFUSED[reason]), reason
        assert not list(result.folder.iterdir()), f"{reason}: something is left"


@pytest.mark.slow
def test_different_options_and_absent_processes_are_one_line(run_tiny):
    assert_refused(run_tiny, "arguments", "absent")


@pytest.mark.slow
def test_other_processes_that_do_not_fit_are_one_line(run_tiny):
    assert_refused(run_tiny, "devices", "twice", "port", "address")


def test_devices_of_one_process_share_batches(run_programs, tmp_path):
    (result,) = run_programs(tmp_path, Program(MESH, tmp_path, dict(os.environ)))
    assert (result.returncode, result.stderr) == (0, "")


TASK = {"SLURM_STEP_NUM_TASKS": "4"}


def test_options_are_a_membership_and_go_before_a_cluster():
    assert membership(2, "node1:5000", 1, TASK) == Membership("node1:5000", 2, 1)
    assert membership(2, "[fe80::1]:5000", 1, {}) == Membership("[fe80::1]:5000", 2, 1)
    assert membership(None, None, None, TASK) == Membership()
    assert membership(None, None, None, {}) is None
    assert membership(1, None, None, TASK) is None
    assert membership(None, None, None, {"SLURM_STEP_NUM_TASKS": "1"}) is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((2, "node1:\uff15\uff10\uff10\uff10", 0), "expected host:port, such as node1:61440"),
        ((2, "n\u00f6de:5000", 0), "expected host:port, such as node1:61440"),
        ((2, None, None), "--coordinator and --process-id missing beside --processes"),
        ((None, "node1:5000", None), "--processes and --process-id missing beside --coordinator"),
        ((2, "node1:5000", None), "--process-id missing beside --processes and --coordinator"),
        ((None, None, 0), "missing beside --process-id"),
        ((1, "node1:5000", 0), "leave them out"),
        ((0, None, None), "expected a positive whole number"),
        ((2, "node1:5000", 2), "expected 0 to 1"),
        ((2, "node1:5000", -1), "expected 0 to 1"),
        ((2, "node1", 0), "expected host:port"),
        ((2, "node1:70000", 0), "expected host:port"),
        ((2, "node1:0", 0), "expected host:port"),
        ((2, "http://node1:5000", 0), "expected host:port"),
        ((2, "::1:5000", 0), "expected host:port"),
    ],
)
def test_half_a_membership_is_refused(options, message):
    with pytest.raises(InputError, match=message):
        membership(*options, {})
