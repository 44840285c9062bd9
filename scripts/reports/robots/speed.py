"""Speed of a seven-axis tree: calls of exported C beside Pinocchio's, and batches in JAX beside Pinocchio's loop."""

import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.export.c.families import functions_of_system
from dln_jax.export.c.load import load_c
from dln_jax.export.c.source import export_c
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.trees import tree_system
from scripts.reports.case import Findings
from scripts.reports.robots.arm import D, arm
from scripts.reports.robots.pinocchio import RIVALS, Timed, call_all, pinocchio_functions, seconds_of_calls
from scripts.reports.rows import Row, expect
from scripts.reports.turns import medians_in_turns

CASE = "seven-axis-tree"
BATCH = 10_000
MOST = 2.0
"""Largest time of our calls, relative to Pinocchio's."""


def speed(quick: bool) -> Findings:
    """Time of a call from Python in C and in Pinocchio, µs, and throughput of batches, states/s, in one run."""
    tree = arm(coulomb=False).tree
    system = tree_system(tree)
    exported = functions_of_system(system, D, dtype=np.float64)
    # Without armature: ours adds it, and Pinocchio does a little less.
    rivals = pinocchio_functions(tree)
    with tempfile.TemporaryDirectory() as place:
        export_c({name: exported[name] for name in RIVALS}, Path(place) / "arm")
        loaded = load_c(Path(place) / "arm")
        ours = {name: Timed(getattr(loaded, name), D) for name in RIVALS}
        seconds = seconds_of_calls({**ours, **rivals}, repetitions=20 if quick else 200)
    rows = [Row(f"{CASE}/{name}", "python_us", 1e6 * seconds[name], "us") for name in RIVALS]
    for name, rival in RIVALS.items() if rivals else ():
        rows.append(Row(f"{CASE}/{name}", "pinocchio_us", 1e6 * seconds[rival], "us"))
        words = f"from Python, the time of {rival} of Pinocchio"
        rows.append(expect(f"{CASE}/{name}", f"over_{rival}", words, seconds[name] / seconds[rival], MOST))
    states = tuple(np.random.default_rng(0).normal(size=(3, BATCH, D)))
    batched = jax.jit(jax.vmap(dynamics(system).inverse_dynamics))
    on_device = tuple(map(jnp.asarray, states))
    loops = {"jax": lambda: jax.block_until_ready(batched(*on_device))}
    if "rnea" in rivals:
        listed = list(zip(*states, strict=True))
        loops["pinocchio"] = lambda: call_all(rivals["rnea"].function, listed)
    for name, median in medians_in_turns(loops, (), repetitions=3 if quick else 15).items():
        rows.append(Row(f"{CASE}/batch-of-{BATCH}", f"{name}_states_per_second", BATCH / median, "1/s"))
    return Findings(rows)
