"""Results for creatures and values on the devices that JAX sees: `shared_batches.py FOLDER NAME [PROCESS PORT]`.

Writes FOLDER/NAME.npz. What the first run has learned half way it leaves in FOLDER/half, and every run continues.
"""

import shutil
import sys

import jax
import jax.numpy as jnp
import numpy as np
from sharing import begun

from dln_jax.control.optimal.action_costs import quadratic
from dln_jax.control.optimal.fitted import Iteration, fit_value
from dln_jax.control.optimal.problem import ControlProblem
from dln_jax.control.optimal.value_networks import fit_hjb, value_network
from dln_jax.locomotion.gradient import GradientSettings, make_policy
from dln_jax.locomotion.learning import learn, make_learner
from dln_jax.locomotion.task import make_task
from dln_jax.scale import batch_mesh
from dln_jax.softbody.identification import ObservedMotions, identify
from dln_jax.softbody.mesh.mesh import make_mesh
from dln_jax.softbody.mesh.shapes import Creature
from dln_jax.softbody.scene import State
from dln_jax.softbody.step import Stepper

LINE = ControlProblem(
    lambda x: x, lambda x: jnp.ones((1, 1)), lambda x: 0.5 * x @ x, quadratic(1.0), 0.2, [-2.0], [2.0], (), [0.0]
)
FEW = Iteration(iterations=2, starts=6, seconds=0.1, dt=0.025, steps=3, batch=8, kept=2)


def block():
    """Two triangles on the ground, and a muscle along one side."""
    mesh = make_mesh([[0.0, 0.0], [0.4, 0.0], [0.0, 0.4], [0.4, 0.4]], [[0, 1, 2], [1, 3, 2]])
    return make_task(Creature("block", mesh, np.array([[0, 2]])), episode=3, clock_period=4.0, upright=0.1)


def walked(folder, name, learner):
    """Parameters and distances of a run of two updates, and of one that is continued after the first."""
    given, steps = {"seed": 1, "settings": {"learner": name}}, learner.steps
    half, whole = folder / "half" / name, 2 * steps
    if not half.exists():
        half.mkdir(parents=True)
        learn(learner, steps=steps, directory=half, **given)
    copy = shutil.copytree(half, folder / f"{name}-{sys.argv[2]}")
    runs = [
        learn(learner, steps=whole, **given),
        learn(learner, steps=whole, directory=copy, resume=True, **given),
    ]
    return [(run.parameters, [record.distance for record in run.records]) for run in runs]


def stiffness(mesh):
    """Identifies a spring from three motions, which neither two nor four devices divide; a body takes long to trace."""

    def step(stiffness, state, control):
        v = state.v - 0.1 * stiffness * jnp.sin(state.x)
        return State(state.x + 0.1 * v, v), None

    x0 = jnp.asarray([1.0, 1.1, 0.9])[:, None, None]
    motions = ObservedMotions(x0, jnp.zeros((3, 1, 1)), jnp.zeros((3, 2, 0)), 0.9 * jnp.stack([x0, x0], axis=1))
    found = identify(Stepper(State, step), lambda theta: theta, jnp.asarray(2.0), motions, iterations=3, mesh=mesh)
    return found.parameters, found.misfit


def value(mesh):
    """Parameters of a value, and what came of them on the way; six states do not divide among four."""
    found = fit_value(LINE, value_network(LINE, widths=()), numbers=FEW, double=True, mesh=mesh)
    return found.parameters, [(at.loss, at.validation) for at in found.history]


def equation(mesh):
    """Parameters of a value by the equation, and how many draws that took; nine samples do not divide."""
    network = value_network(LINE, widths=())
    start, given = network.init(jax.random.key(2)), {"samples": 9, "validation": 4, "iterations": 3, "rounds": 1}
    start = jax.tree.map(lambda leaf: leaf.astype(float), start)
    found = fit_hjb(LINE, network.value_and_gradient, start, jax.random.key(3), mesh=mesh, **given)
    return found.parameters, len(found.history)


def main(folder, name, *, whole):
    mesh = batch_mesh()
    found = {"stiffness": stiffness(mesh), "value": value(mesh)}
    if whole:
        task, settings = block(), GradientSettings(window=3, lanes=4, updates=1)
        gradient = make_learner(task, make_policy(task, width=2), settings, steps=1000, mesh=mesh)
        found |= {"gradient": walked(folder, "gradient", gradient)}
        found |= {"equation": equation(mesh)}
    arrays = {
        f"{subject} {number}": np.asarray(leaf)
        for subject, results in found.items()
        for number, leaf in enumerate(jax.tree.leaves(results))
    }
    np.savez(folder / f"{name}.npz", devices=1 if mesh is None else mesh.size, **arrays)


if __name__ == "__main__":
    own_folder, own_name, of_two = begun()
    # Gradients of a body take long to compile: not in two processes too.
    main(own_folder, own_name, whole=not of_two)
