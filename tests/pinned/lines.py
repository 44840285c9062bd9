"""Command lines on small data, and the results that a change of the code must not alter.

`python -m pytest -n 0 tests/pinned --pinned` compares them with `pins.json`, and `--renew` stores them anew; a commit
that does so says why. Another processor or JAX rounds otherwise: there, renew them before a change.
"""

import hashlib
import importlib
import inspect
import json
import re
import shlex
from collections.abc import Callable
from pathlib import Path

import numpy as np
import safetensors.numpy
from calls import command
from motions import sums_of_sines
from planar_arm import URDF

import dln_jax
from dln_jax.commands import COMMANDS
from dln_jax.data import schema
from dln_jax.data.checks.report import quick
from dln_jax.data.splits import split
from dln_jax.scenes.datasets import generators
from dln_jax.scenes.pendulums import cart_pole, pendulum, two_link_arm

SMALL = "--width 4 --depth 1"
BRIEF = "--no-figures --no-uncertainty"
LINES = {
    **{
        f"train_delan-{model}": f"train_delan --data arm.npz --model {model} {more} {BRIEF}"
        for model, more in {
            "structured-delan": f"--optimizer gauss-newton --steps 5 {SMALL}",
            "black-box-delan": f"--optimizer gauss-newton --steps 5 {SMALL}",
            "feed-forward": f"--optimizer adam --steps 20 {SMALL} --precision f64",
            "trigonometric": "",
            "trigonometric-kernel": "--samples 40",
        }.items()
    },
    "train_delan-letters": f"train_delan --steps 3 {SMALL} {BRIEF}",
    "train_delan-motors": "train_delan --data cart.npz --model structured-delan --steps 5 "
    f"--optimizer gauss-newton {SMALL} {BRIEF}",
    "train_hnn": f"train_hnn --data arm.npz --optimizer gauss-newton --steps 5 {SMALL} {BRIEF}",
    "train_hnn_task-spring": "train_hnn_task --task spring --trajectories 10 --steps 5 --no-figures",
    "train_hnn_task-pendulum": "train_hnn_task --task pendulum --trajectories 10 --steps 5 --no-figures",
    "train_hnn_task-measured": "train_hnn_task --task measured --data swings.npz --test 3 --steps 5 "
    f"--model separable-hnn {SMALL} --no-figures",
    "train_hnn_task-momenta": "train_hnn_task --task measured --data momenta.npz --test 3 --steps 5 "
    f"--model separable-hnn {SMALL} --no-figures",
    **{
        f"identify-{name}": f"identify --robot arm.urdf --data log.npz --no-figures --no-uncertainty {more}"
        for name, more in {
            "torques": "--test last:30%",
            "filtered": "--test last:30% --cutoff 8",
            "motions": "--test last:30% --by motions --window 0.3 --cutoff 8",
            "both": "--test last:30% --by both --window 0.3",
        }.items()
    },
    "train_value": "train_value --plant pendulum --iterations 1 --width 8 --depth 1 --starts 4 --no-figures",
    "train_diffnet": "train_diffnet --samples 50 --steps 2 --width 4 --depth 1 --no-figures",
    "simulate-beam": "simulate --scene beam --cells 1 --seconds 0.05 --no-figures --precision f64",
    "train_locomotion": "train_locomotion --steps 64 --window 4 --episode 8 --width 4 --no-figures",
    "swing_up": "swing_up --plant cart-pole --model known --starts 2 --no-figures",
    "sweep": "sweep --grid width=2,3 --jobs 1 --fixed 'data=arm.npz model=structured-delan steps=2 depth=1'",
    "check_data": "check_data --data log.npz --no-figures",
    "learned-tree": f"train_delan --data arm.npz --model learned-tree {BRIEF}",
}
"""Command lines by name."""
TIMES = re.compile(r"seconds|_us$|per_second|latency|calls|_ms$")
"""Entries of metrics.json that measure time."""
LOGS = ("arm", "cart", "swings", "momenta", "log", "letters")
SPOILED: dict[str, Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]]] = {
    "degrees": lambda log: log | {"q": np.degrees(log["q"])},
    "late": lambda log: log | {"tau": np.roll(log["tau"], 5, axis=0)},
    "crossed": lambda log: log | {"tau": log["tau"][:, ::-1]},
    "reversed": lambda log: log | {"tau": log["tau"] * [1, -1]},
    "frozen": lambda log: log | {"q": np.where(np.arange(len(log["q"]))[:, None] // 20 % 9, log["q"], log["q"][0])},
    "noisy": lambda log: log | {"q": log["q"] + 0.01 * np.random.default_rng(2).normal(size=log["q"].shape)},
}
"""Faults of logs with the right shapes."""
DAMAGED: dict[str, Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]]] = {
    "without q": lambda log: {key: x for key, x in log.items() if key != "q"},
    "NaN": lambda log: log | {"q": np.where(log["t"][:, None] == 1.0, np.nan, log["q"])},
    "short": lambda log: log | {"tau": log["tau"][:-1]},
    "one joint less": lambda log: log | {"tau": log["tau"][:, :1]},
    "text": lambda log: log | {"q": log["q"].astype(str)},
    "objects": lambda log: log | {"q": log["q"].astype(object)},
    "time backwards": lambda log: log | {"t": log["t"][::-1]},
    "empty": lambda log: {key: x[:0] for key, x in log.items()},
}
"""Faults of logs that no command accepts."""


def make_files(folder):
    """Small logs and a robot's file."""
    arm = generators.uniform(two_link_arm(), samples=60)
    schema.save(folder / "arm.npz", arm)
    schema.save(folder / "cart.npz", generators.uniform(cart_pole(friction=0.1), samples=60))
    swings = generators.free_swing(pendulum(), trajectories=4, steps=40)
    np.savez(folder / "swings.npz", t=swings.t, q=swings.q, trajectory=swings.trajectory)
    np.savez(folder / "momenta.npz", t=swings.t, q=swings.q, p=swings.p, trajectory=swings.trajectory)
    schema.save(folder / "letters.npz", generators.characters(letters=("a", "b", "c", "d")))
    (folder / "arm.urdf").write_text(URDF)
    t = np.arange(0, 6, 0.02)
    amplitude, rate, phase = np.random.default_rng(0).uniform([0.2, 1, 0], [0.8, 4, 6], (2, 3, 3)).transpose(2, 0, 1)
    q, qd, qdd = sums_of_sines(t, amplitude, rate, phase)
    true = read_tree(folder / "arm.urdf")
    tau = np.array([true(*row) for row in zip(q, qd, qdd, strict=True)])
    tau += 0.05 * np.random.default_rng(1).normal(size=tau.shape)
    log = {"t": t, "q": q, "qd": qd, "qdd": qdd, "tau": tau, "trajectory": np.repeat(np.arange(4), len(t) // 4)}
    np.savez(folder / "log.npz", **log)
    for name, spoil in {**SPOILED, **DAMAGED}.items():
        np.savez(folder / f"{name}.npz", **spoil(log))


def read_tree(path):
    """Torques of the file's robot with half as much mass again, armature and friction."""
    import jax

    from dln_jax import joint_dissipation, tree_system
    from dln_jax.data.robots import read_robot
    from dln_jax.mechanics.equations import dynamics

    tree = read_robot(path).tree
    tree = tree._replace(inertias=1.5 * tree.inertias, armature=np.array([0.1, 0.2]))
    return jax.jit(dynamics(tree_system(tree, joint_dissipation([0.4, 0.2], [0.5, 0.1]))).inverse_dynamics)


def masked(text):
    """The text with numbers and frames of tables taken out, so that a digit or a column's width does not matter."""
    lines = (re.sub(r"[-+]?\d[\d.,]*(e[-+]?\d+)?", "#", line) for line in text.splitlines())
    lines = (re.sub(r"[\s│┃━─┏┓┗┛┡┩└┘┳┻╇┴╭╮╰╯]+", " ", line).strip() for line in lines)
    return [line for line in lines if line and not line.startswith("#/# jobs")]  # as many as the jobs take time


def ended(capsys, script, *words):
    """The exit status of a command, and what it prints."""
    try:
        command(importlib.import_module(f"dln_jax.commands.{script}"), *words)
        status = 0
    except SystemExit as end:
        status = end.code
    told = capsys.readouterr()
    return {"status": status, "printed": masked(told.out), "error": masked(told.err)}


def measured(name, capsys):
    """Returns what a command line writes into the working folder and prints."""
    script, *words = shlex.split(LINES[name])
    folder = Path(name)
    found = ended(capsys, script, *words, "--out", folder)
    if (folder / "metrics.json").exists():
        metrics = json.loads((folder / "metrics.json").read_text())
        found["metrics"] = {key: value for key, value in metrics.items() if not TIMES.search(key)}
    if (folder / "table.csv").exists():
        found["columns"] = (folder / "table.csv").read_text().splitlines()[0]
    if (folder / "config.json").exists():
        config = json.loads((folder / "config.json").read_text())
        found["keys of config"] = sorted(config)
    if (folder / "model.json").exists():
        found["description"] = json.loads((folder / "model.json").read_text()).get("model")
        tensors = safetensors.numpy.load_file(folder / "model.safetensors")
        # Norms rather than a digest, because rounding differs between processors.
        found["parameters"] = {key: [*x.shape, float(np.linalg.norm(x))] for key, x in tensors.items()}
    return found


def splits_and_findings(name):
    """Sizes and marks of the parts of a log, and what its checks find."""
    data = schema.load(f"{name}.npz")
    parts = split(data)
    rows = {
        part: hashlib.sha256(np.ascontiguousarray(getattr(parts, part).t).tobytes()).hexdigest()[:12]
        for part in parts._fields
        if hasattr(getattr(parts, part), "t")
    }
    return {"parts": rows, "findings": [f"{f.severity} {f.check} {list(f.joints)}" for f in quick(data)]}


def public_names():
    """Public names, and the names of their arguments: their types are written otherwise by other versions."""
    found = {}
    for name in sorted(dln_jax.__all__):
        value = getattr(dln_jax, name)
        try:
            arguments = inspect.signature(value).parameters.values()
            found[name] = [
                f"{each.kind.name} {each.name}{'=' * (each.default is not each.empty)}" for each in arguments
            ]
        except (TypeError, ValueError):
            found[name] = type(value).__name__
    return found


def help_texts(capsys):
    """Options of every command with their types and defaults, as its help shows them."""
    found = {}
    for name in COMMANDS:
        try:
            command(importlib.import_module(f"dln_jax.commands.{name}"), "--help-all")
        except SystemExit:
            found[name] = re.findall(r"--[a-z][\w-]*", capsys.readouterr().out)
    return found
