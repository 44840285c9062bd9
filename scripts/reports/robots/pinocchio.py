"""Pinocchio, a rival in dynamics of rigid bodies: its model of a tree, its functions, and a regression by it."""

import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import DTypeLike

from dln_jax.data import Trajectories
from dln_jax.export.c.families import functions_of_system
from dln_jax.export.c.load import load_c
from dln_jax.export.c.source import export_c
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.trees import Tree, inertial_parameters, serial, tree_system
from scripts.reports.robots.arm import D, Torque, arm
from scripts.reports.run import Numbers
from scripts.reports.timing import medians_in_turns

STATES, BATCH = 256, 10_000
RIVALS = {"inverse_dynamics": "rnea", "forward_dynamics": "aba"}
"""Pinocchio's functions with the same arguments."""


class Timed(NamedTuple):
    """A function of a state of three vectors [d]."""

    function: Callable[..., Any]
    d: int
    dtype: DTypeLike = np.float64
    title: str = ""
    """Name and release of a rival."""


def speed(*, repetitions: int = 200, batches: int = 15) -> Numbers:
    """Time of a call from Python in C and in Pinocchio, and throughput of batches, for a seven-axis tree."""
    tree = arm(coulomb=False).tree
    system = tree_system(tree)
    exported = functions_of_system(system, D, dtype=np.float64)
    # Without armature: ours adds it, and Pinocchio does a little less.
    rivals = pinocchio_functions(tree)
    with tempfile.TemporaryDirectory() as place:
        export_c({name: exported[name] for name in RIVALS}, Path(place) / "arm")
        loaded = load_c(Path(place) / "arm")
        ours = {name: Timed(getattr(loaded, name), D) for name in RIVALS}
        seconds = seconds_of_calls({**ours, **rivals}, repetitions=repetitions)
    numbers = {}
    for name, rival in RIVALS.items():
        times = {"python_us": 1e6 * seconds[name]}
        if rivals:
            times |= {"pinocchio_us": 1e6 * seconds[rival], f"over_{rival}": seconds[name] / seconds[rival]}
        numbers[f"seven-axis-tree/{name}"] = times
    states = tuple(np.random.default_rng(0).normal(size=(3, BATCH, D)))
    batched = jax.jit(jax.vmap(dynamics(system).inverse_dynamics))
    loops = {"jax": partial(batched, *map(jnp.asarray, states))}
    if rivals:
        loops["pinocchio"] = partial(call_all, rivals["rnea"].function, list(zip(*states, strict=True)))
    medians = medians_in_turns(loops, (), repetitions=batches)
    rates = {f"{name}_states_per_second": BATCH / median for name, median in medians.items()}
    return {**numbers, f"seven-axis-tree/batch-of-{BATCH}": rates}


def seconds_of_calls(functions: Mapping[str, Timed], *, repetitions: int) -> dict[str, float]:
    """Times of calls with arrays in and out, s; loops over random states take turns, and medians count."""
    random, loops = np.random.default_rng(0), {}
    for name, (function, d, dtype, _) in functions.items():
        states = random.normal(size=(STATES, 3, d)).astype(dtype)
        loops[name] = partial(call_all, function, [tuple(state) for state in states])
    medians = medians_in_turns(loops, (), repetitions=repetitions)
    return {name: seconds / STATES for name, seconds in medians.items()}


def call_all(function: Callable[..., Any], states: Sequence[tuple[np.ndarray, ...]]) -> None:
    """Calls a function with all states."""
    for state in states:
        function(*state)


def pinocchio() -> Any:
    """The package; prints a line and returns `None` if it is missing."""
    try:
        import pinocchio as pin
    except ImportError:
        print("Pinocchio is missing, and so are its rows; pip install 'dln-jax[reference]'")
        return None
    return pin


def pinocchio_model(pin: Any, tree: Tree) -> Any:
    """The same tree, without armature."""
    model = pin.Model()
    model.gravity.linear = np.asarray(tree.gravity)
    # Pinocchio has a faster model for joints about z.
    along_z = {"revolute": pin.JointModelRZ, "prismatic": pin.JointModelPZ}
    others = {"revolute": pin.JointModelRevoluteUnaligned, "prismatic": pin.JointModelPrismaticUnaligned}
    for link, parent in enumerate(tree.parents):
        place = pin.SE3(np.asarray(tree.rotations[link]), np.asarray(tree.positions[link]))
        kind, axis = tree.joints[link], np.asarray(tree.axes[link], float)
        joint = along_z[kind]() if np.array_equal(axis, [0, 0, 1]) else others[kind](axis)
        added = model.addJoint(parent + 1, joint, place, f"joint_{link}")
        m, hx, hy, hz, xx, xy, xz, yy, yz, zz = np.asarray(tree.inertias[link])
        # Pinocchio's order of the same ten numbers.
        inertia = pin.Inertia.FromDynamicParameters(np.array([m, hx, hy, hz, xx, xy, yy, xz, yz, zz]))
        model.appendBodyToJoint(added, inertia, pin.SE3.Identity())
    return model


def pinocchio_functions(tree: Tree) -> dict[str, Timed]:
    """Pinocchio's inverse and forward dynamics of a tree without armature; none if the package is missing."""
    if (pin := pinocchio()) is None:
        return {}
    model, d, release = pinocchio_model(pin, tree), tree.degrees_of_freedom, f"Pinocchio {pin.__version__}"
    call = lambda name: partial(getattr(pin, name), model, model.createData())  # noqa: E731
    return {name: Timed(call(name), d, title=f"{name} of {release}") for name in RIVALS.values()}


def rival_arm(d: int) -> Tree:
    """An arm of d revolute joints about the z axes of random frames, which Pinocchio handles fastest."""
    random = np.random.default_rng(2)
    turns = np.linalg.qr(random.normal(size=(d, 3, 3)))[0]
    rotations = turns * np.sign(np.linalg.det(turns))[:, None, None]
    links = [
        inertial_parameters(random.uniform(1.0, 3.0), 0.1 * random.normal(size=3), np.diag(random.uniform(1, 1.5, 3)))
        for _ in range(d)
    ]
    return serial(rotations, 0.3 * random.normal(size=(d, 3)), links)


def regression(tree: Tree, data: Trajectories, velocity_scale: Any) -> Torque | None:
    """Least squares by Pinocchio's regressor with armature, viscous, dry friction and an offset of each joint.

    `velocity_scale` is that of `joint_dissipation`, by joint or one for all. `None` without Pinocchio.
    """
    if (pin := pinocchio()) is None:
        return None
    model = pinocchio_model(pin, tree)
    of_states, d = model.createData(), tree.degrees_of_freedom

    def stacked(*states: Any) -> np.ndarray:
        rows = []
        for q, qd, qdd in zip(*map(np.asarray, states), strict=True):
            joints = (np.diag(rates) for rates in (qdd, qd, np.tanh(qd / velocity_scale), np.ones(d)))
            rows.append(np.hstack([pin.computeJointTorqueRegressor(model, of_states, q, qd, qdd), *joints]))
        return np.concatenate(rows)

    theta = np.linalg.lstsq(stacked(data.q, data.qd, data.qdd), data.tau.ravel(), rcond=1e-10)[0]
    return lambda *states: (stacked(*states) @ theta).reshape(-1, d)
