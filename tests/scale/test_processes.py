"""Commands in several processes, each of its own: what they compute, how they refuse, and how they lose another."""

import os
import signal
import socket
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from interpreters import Program, interpreters
from safetensors.numpy import load_file

from dln_jax.scale.meeting import Membership
from dln_jax.scale.processes import membership
from dln_jax.types import InputError

TINY = '''
"""A command that iterates a map whose every step needs all devices, and in which a process may be lost."""
import dataclasses, os, signal, subprocess, sys
import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.cli.options import Resumable, Scaled
from dln_jax.cli.progress import progress
from dln_jax.cli.running import run
from dln_jax.cli.stored_arguments import command_folder
from dln_jax.cli.scaled import mesh_of
from dln_jax.scale.mesh import gathered, shard, spread, summed
from dln_jax.scale.processes import process_key
from dln_jax.types import InputError
from dln_jax.zoo.parameter_files import load_tree, save_tree

LOST, JOINING = os.environ.get("LOST", ""), int(os.environ.get("JOINING", "60"))

@dataclasses.dataclass(frozen=True)
class Arguments(Resumable, Scaled):
    """What to iterate."""
    seed: int = 0
    """Of nothing."""

def lose(process):
    who, _, how = LOST.partition(" ")
    if who != str(process):
        return
    if how == "error":
        raise InputError("the disk is full")
    if how == "SIGSTOP":
        subprocess.Popen(["sh", "-c", f"sleep 30; kill -9 {os.getpid()}"])  # nothing else ends one that is stopped
    os.kill(os.getpid(), getattr(signal, how))

def main(given):
    mesh = mesh_of(given)
    places = shard(np.arange(4.0), mesh)
    step = jax.jit(spread(lambda state, places: jnp.cos(3.0 * jnp.sum(state) + places), mesh))
    total = jax.jit(summed(lambda scale, places: scale * jnp.sum(places), mesh))
    with command_folder(given, "tiny") as folder, progress(8) as show:
        print("I am the first")
        state = {"done": np.array(0), "places": np.zeros(4)}
        if given.resume:
            state = load_tree(folder, "state", state)
        for done in range(int(state["done"]) + 1, 9):
            state = {"done": np.array(done), "places": np.asarray(step(np.asarray(state["places"]), places))}
            save_tree(folder, "state", state, {}, number=done)
            show(done, "")
            if done == 4:
                lose(given.process_id or 0)
        assert float(total(2.0, places)) == 12.0
        key = np.asarray(jax.random.key_data(process_key(jax.random.key(0))))
        keys = gathered(shard(np.tile(key, (4, 1)), mesh))
        devices = np.array(mesh.size if mesh else 1)
        save_tree(folder, "result", {**state, "keys": np.asarray(keys), "devices": devices}, {})

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


class Started(NamedTuple):
    """What became of processes that were started together."""

    codes: tuple[int, ...]
    out: list[str]
    err: list[str]
    folder: Path

    @property
    def result(self):
        return load_file(self.folder / "run" / "result.safetensors")


@pytest.fixture(scope="module")
def run_programs():
    told = {key: value for key, value in os.environ.items() if not key.startswith(("JAX_", "SLURM_"))}
    with interpreters(told) as run:
        yield run


@pytest.fixture(scope="module")
def run_tiny(run_programs, tmp_path_factory):
    """A function that runs the command once for each list of processes, all beside each other."""
    path = tmp_path_factory.mktemp("tiny") / "tiny.py"
    path.write_text(TINY)

    def run(*runs):
        programs, folders = [], []
        for processes, told, folder in runs:
            folder = folder or tmp_path_factory.mktemp("run")
            folders.append(folder)
            for options, more in processes:
                environment = {key: value for key, value in os.environ.items() if not key.startswith("SLURM_")}
                programs.append(Program(path, folder, {**environment, **told, **more}, ("--out", "run", *options)))
        results = iter(run_programs(path.parent, *programs))
        started = []
        for (processes, _, _), folder in zip(runs, folders, strict=True):
            each = [next(results) for _ in processes]
            codes = tuple(result.returncode for result in each)
            texts = ([getattr(result, name) for result in each] for name in ("stdout", "stderr"))
            started.append(Started(codes, *texts, folder))
        return started

    return run


def free_port():
    with socket.socket() as asked:
        asked.bind(("127.0.0.1", 0))
        return asked.getsockname()[1]


def pair(*more, first=(), second=(), host="127.0.0.1", port=None):
    """Arguments of two processes."""
    both = ("--processes", "2", "--coordinator", f"{host}:{port or free_port()}", *more)
    return [((*both, "--process-id", "0", *first), {}), ((*both, "--process-id", "1", *second), {})]


def slurm_pair(*more):
    """What Slurm says to two tasks of a step, on this host."""
    step = {"SLURM_JOB_ID": str(free_port()), "SLURM_STEP_NUM_TASKS": "2", "SLURM_NTASKS": "2"}
    step |= {"SLURM_STEP_NODELIST": "localhost"}
    return [(more, {**step, "SLURM_PROCID": str(k), "SLURM_LOCALID": str(k)}) for k in range(2)]


@pytest.fixture(scope="module")
def trained(run_tiny):
    """One process, two, two by Slurm, and two of which one is lost in each of several ways."""
    lost = ("1 SIGKILL", "1 SIGSTOP", "0 SIGKILL", "1 error")
    runs = [([((), {})], {}, None), (pair(), {}, None), (slurm_pair("--devices", "2"), {}, None)]
    started = run_tiny(*runs, *((pair(), {"LOST": how}, None) for how in lost))
    return dict(zip(("alone", "two", "slurm", *lost), started, strict=True))


def assert_same_result(started, alone):
    np.testing.assert_array_equal(started.result["places"], alone.result["places"])
    assert started.result["done"] == 8


@pytest.mark.parametrize("way", ["two", "slurm"])
def test_two_processes_give_what_one_gives(trained, way):
    started, alone = trained[way], trained["alone"]
    assert (started.codes, started.err) == ((0, 0), ["", ""])
    assert_same_result(started, alone)
    assert (started.result["devices"], alone.result["devices"]) == (2 if way == "two" else 4, 1)
    assert len(np.unique(started.result["keys"], axis=0)) == 2


@pytest.mark.parametrize("way", ["two", "slurm"])
def test_the_first_process_alone_prints_and_writes(trained, way):
    out = trained[way].out
    assert out[0].startswith("2 processes, ") and "I am the first" in out[0] and "Gloo" not in out[0] and not out[1]


LOSSES = {"1 SIGKILL": (3, -9), "0 SIGKILL": (-9, 3), "1 error": (3, 2), "1 SIGSTOP": (-signal.SIGABRT, -9)}


@pytest.mark.parametrize("how", LOSSES)
def test_a_lost_process_ends_the_others(trained, how):
    """With a line that says how to go on, unless JAX's own runtime is the first to notice, and aborts."""
    started, expected = trained[how], LOSSES[how]
    remaining = 1 - expected.index(-9 if -9 in expected else 2)
    code, err = started.codes[remaining], started.err[remaining]
    assert started.codes[1 - remaining] == expected[1 - remaining]
    if how in ("1 SIGKILL", "1 error"):
        assert code == 3 and err.startswith("error: another process is lost") and len(err.splitlines()) == 1
        assert "run with --resume in all processes" in err
    else:
        assert code in (3, -signal.SIGABRT) and "another" in err


def test_a_broken_run_continues_as_if_unbroken(run_tiny, trained):
    """In two processes, whichever was lost, and in one alone."""
    broken = [trained[how] for how in ("1 SIGKILL", "0 SIGKILL", "1 SIGSTOP")]
    for each in broken:
        assert not (each.folder / "run" / "result.json").exists()
    processes = [pair("--resume"), pair("--resume"), [(("--resume",), {})]]
    for started in run_tiny(*((each, {}, was.folder) for each, was in zip(processes, broken, strict=True))):
        assert set(started.codes) == {0} and not any(started.err)
        assert_same_result(started, trained["alone"])
        assert (started.folder / "run" / "config.json").read_text().find("process") < 0


@pytest.fixture(scope="module")
def refused(run_tiny):
    """Pairs that cannot be one program, all beside each other."""
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
        return dict(zip(runs, run_tiny(*runs.values()), strict=True))


REFUSED = {
    "arguments": ("--seed is 1 in process 0 and 2 in process 1; all processes need the same command",) * 2,
    "devices": ("--devices is None in process 0 and 3 in process 1",) * 2,
    "twice": ("processes [1] of 2 did not come", "of --coordinator is not free"),
    "absent": ("processes [1] of 2 did not come",),
    "port": ("of --coordinator is not free", "cannot reach"),
    "address": ("processes [1] of 2 did not come", "cannot reach no-such-host.invalid"),
}


@pytest.mark.parametrize("why", REFUSED)
def test_what_cannot_be_one_program_is_one_line_in_all_processes(refused, why):
    started = refused[why]
    lines = [err.splitlines() for err in started.err]
    assert set(started.codes) == {2} and all(len(each) == 1 and each[0].startswith("error: ") for each in lines)
    # Of two processes with one number either may be the first.
    assert all(any(message in err for err in started.err) for message in REFUSED[why])
    assert not list(started.folder.iterdir()), "something is left"


def test_devices_of_one_process_share_batches(run_programs, tmp_path):
    (result,) = run_programs(tmp_path, Program(MESH, tmp_path, dict(os.environ)))
    assert (result.returncode, result.stderr) == (0, "")


TASK = {"SLURM_STEP_NUM_TASKS": "4"}


def test_options_are_a_membership_and_go_before_a_cluster():
    assert membership(2, "node1:5000", 1, TASK) == Membership(2, "node1:5000", 1)
    assert membership(2, "[fe80::1]:5000", 1, {}) == Membership(2, "[fe80::1]:5000", 1)
    assert membership(None, None, None, TASK) == Membership()
    assert membership(None, None, None, {}) is None
    assert membership(1, None, None, TASK) is None
    assert membership(None, None, None, {"SLURM_STEP_NUM_TASKS": "1"}) is None


@pytest.mark.parametrize(
    ("options", "message"),
    [
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
