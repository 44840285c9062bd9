"""Commands in several processes, each of its own: what they compute, how they refuse, and how they lose another."""

import os
import socket
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from interpreters import Program, interpreters
from safetensors.numpy import load_file

TINY = '''
"""A command that iterates a map whose every step needs all devices, and in which a process may be lost."""
import dataclasses, os, signal, sys, time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.command_line.options import Resumable, Scaled
from dln_jax.command_line.progress import progress
from dln_jax.command_line.running import command_folder, run
from dln_jax.command_line.scaled import mesh_of
from dln_jax.scale.mesh import gathered, shard, spread, summed
from dln_jax.scale.processes import process_key
from dln_jax.scale.signs import Limits
from dln_jax.types import InputError
from dln_jax.zoo.parameter_files import load_tree, save_tree

LOST, JOINING = os.environ.get("LOST", ""), float(os.environ.get("JOINING", "30"))
IDLE = 6.0 if "idle" in LOST else 600.0
LIMITS = Limits(beat=0.1, silent=5.0, grace=0.5, meeting=JOINING, joining=JOINING, idle=IDLE)

@dataclasses.dataclass(frozen=True)
class Arguments(Resumable, Scaled):
    """What to iterate."""
    seed: int = 0
    """Of nothing."""

def lose(process):
    who, _, how = LOST.partition(" ")
    if who != str(process):
        return
    if how == "idle":
        time.sleep(1000)
    if how == "error":
        raise InputError("the disk is full")
    victims = os.getppid(), os.getpid()
    if how == "SIGSTOP":
        Path("stopped").write_text(" ".join(map(str, victims)))
    for victim in victims[:1] if how == "SIGKILL" else victims:
        os.kill(victim, getattr(signal, how))

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
    run(main, Arguments, prog="tiny", limits=LIMITS)
except SystemExit as stop:
    code = stop.code
for victim in Path("stopped").read_text().split() if Path("stopped").exists() else ():
    os.kill(int(victim), signal.SIGKILL)
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
    step = {"SLURM_JOB_ID": str(free_port()), "SLURM_STEP_ID": "0", "SLURM_STEP_NUM_TASKS": "2"}
    step |= {"SLURM_STEP_NODELIST": "localhost", "SLURM_NTASKS": "2", "SLURM_STEP_TASKS_PER_NODE": "2"}
    return [(more, {**step, "SLURM_PROCID": str(k), "SLURM_LOCALID": str(k)}) for k in range(2)]


@pytest.fixture(scope="module")
def trained(run_tiny):
    """One process, two, two by Slurm, and two of which one is lost in each of several ways."""
    lost = ("1 SIGKILL", "1 SIGSTOP", "0 SIGKILL", "1 error", "1 idle")
    runs = [([((), {})], {}, None), (pair(), {}, None), (slurm_pair("--devices", "2"), {}, None)]
    started = run_tiny(*runs, *((pair(), {"LOST": how}, None) for how in lost))
    return dict(zip(("alone", "two", "slurm", *lost), started, strict=True))


def complaints(err):
    """Lines on the standard error but those of a machine that is slow."""
    return [line for line in err.splitlines() if not line.startswith("waiting for")]


def assert_same_result(started, alone):
    np.testing.assert_array_equal(started.result["places"], alone.result["places"])
    assert started.result["done"] == 8


@pytest.mark.parametrize("way", ["two", "slurm"])
def test_two_processes_give_what_one_gives(trained, way):
    started, alone = trained[way], trained["alone"]
    assert started.codes == (0, 0) and not any(map(complaints, started.err))
    assert_same_result(started, alone)
    assert (started.result["devices"], alone.result["devices"]) == (2 if way == "two" else 4, 1)
    assert len(np.unique(started.result["keys"], axis=0)) == 2


@pytest.mark.parametrize("way", ["two", "slurm"])
def test_the_first_process_alone_prints_and_writes(trained, way):
    out = trained[way].out
    assert out[0].startswith("2 processes on 1 host") and ("Slurm" in out[0]) == (way == "slurm")
    assert "I am the first" in out[0] and "Gloo" not in out[0] and not out[1]
    assert [path.name for path in trained[way].folder.iterdir()] == ["run"], "they met in a folder that is left"


LOSSES = {
    "1 SIGKILL": ((3, -9), "process 1 on {host}: no sign of life"),
    "1 SIGSTOP": ((3, -9), "process 1 on {host}: no sign of life"),
    "0 SIGKILL": ((-9, 3), "process 0 on {host}: no sign of life"),
    "1 idle": ((3, 3), "process 0 on {host}: no progress"),
    "1 error": ((3, 2), "process 1 on {host}: the disk is full"),
}


@pytest.mark.parametrize("how", LOSSES)
def test_a_lost_process_ends_the_others_with_a_line(trained, how):
    codes, said = LOSSES[how]
    started = trained[how]
    assert started.codes == codes
    (line,) = complaints(started.err[codes.index(3)])
    assert line.startswith(f"error: {said.format(host=socket.gethostname())}") and "--resume" in line


def test_a_broken_run_continues_as_if_unbroken(run_tiny, trained):
    """In two processes, whichever was lost, and in one alone."""
    broken = [trained[how] for how in ("1 SIGKILL", "0 SIGKILL", "1 SIGSTOP")]
    for each in broken:
        assert not (each.folder / "run" / "result.json").exists()
    (broken[2].folder / "stopped").unlink()
    processes = [pair("--resume"), pair("--resume"), [(("--resume",), {})]]
    for started in run_tiny(*((each, {}, was.folder) for each, was in zip(processes, broken, strict=True))):
        assert set(started.codes) == {0} and not any(map(complaints, started.err))
        assert_same_result(started, trained["alone"])
        assert (started.folder / "run" / "config.json").read_text().find("process") < 0


@pytest.fixture(scope="module")
def refused(run_tiny):
    """Pairs that cannot be one program, all beside each other."""
    taken = socket.socket()
    taken.bind(("", 0))
    taken.listen()
    hurried = {"JOINING": "1.5"}
    runs = {
        "arguments": (pair(first=("--seed", "1"), second=("--seed", "2")), {}, None),
        "devices": (pair(second=("--devices", "3")), {}, None),
        "twice": ([pair()[0]] * 2, hurried, None),
        "absent": (pair()[:1], hurried, None),
        "port": (pair(port=taken.getsockname()[1]), {}, None),
        "address": (pair(host="no-such-host.invalid"), {}, None),
        "no folder": ([((*pair()[0][0], "--out", "/proc/none/run"), {})], {}, None),
    }
    with taken:
        return dict(zip(runs, run_tiny(*runs.values()), strict=True))


REFUSED = {
    "arguments": "--seed is 1 in process 0 and 2 in process 1; all processes need the same command",
    "devices": "--devices is None in process 0 and 3 in process 1",
    "absent": "process 1 of 2 did not come within 1.5 s",
    "port": "of --coordinator is not free here",
    "address": "cannot reach no-such-host.invalid",
    "no folder": "cannot create the folder",
}


@pytest.mark.parametrize("why", REFUSED)
def test_what_cannot_be_one_program_is_one_line_in_all_processes(refused, why):
    started = refused[why]
    for code, err in zip(started.codes, started.err, strict=True):
        (line,) = complaints(err)
        assert code == 2 and line.startswith("error: ") and REFUSED[why] in line
    assert not list(started.folder.iterdir()), "something is left"


def test_one_place_is_not_given_twice(refused):
    """The process that came first says so; the other one is the one that stays."""
    started = refused["twice"]
    assert set(started.codes) == {2} and any("--process-id 0 is given twice" in err for err in started.err)


def test_devices_of_one_process_share_batches(run_programs, tmp_path):
    (result,) = run_programs(tmp_path, Program(MESH, tmp_path, dict(os.environ)))
    assert (result.returncode, result.stderr) == (0, "")
