"""What creatures and values come to on the devices that JAX sees: `shared_batches.py FOLDER NAME [PROCESS PORT]`.

Writes FOLDER/NAME.npz. What the first run has learned half way it leaves in FOLDER/half, and every run continues.
"""

import shutil
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax import compilation
from dln_jax.control.optimal.action_costs import quadratic
from dln_jax.control.optimal.fitted import Iteration, fit_value
from dln_jax.control.optimal.problem import ControlProblem
from dln_jax.control.optimal.value_networks import value_network
from dln_jax.learning.soft_body_identification import ObservedMotions, identify
from dln_jax.locomotion.evolution import EvolutionSettings, make_evolution_learner
from dln_jax.locomotion.gradient import GradientSettings, make_gradient_learner
from dln_jax.locomotion.learning import Goal, compile_learner, learn
from dln_jax.locomotion.policy import make_policy
from dln_jax.locomotion.task import make_task
from dln_jax.scale.mesh import batch_mesh
from dln_jax.softbody.mesh.creatures import Creature
from dln_jax.softbody.mesh.mesh import make_mesh

LINE = ControlProblem(
    lambda x: x, lambda x: jnp.ones((1, 1)), lambda x: 0.5 * x @ x, quadratic(1.0), 0.2, [-2.0], [2.0], (), [0.0]
)
FEW = Iteration(iterations=2, starts=6, seconds=0.1, dt=0.025, steps=3, batch=8, kept=2)


def block():
    """Two triangles on the ground, and a muscle along one side."""
    mesh = make_mesh([[0.0, 0.0], [0.4, 0.0], [0.0, 0.4], [0.4, 0.4]], [[0, 1, 2], [1, 3, 2]])
    return make_task(Creature("block", mesh, np.array([[0, 2]])), episode=3, clock_period=4.0, upright=0.5)


def walked(folder, name, learner, task, mesh):
    """Parameters and distances of a run of two updates, and of one that is continued after the first."""
    compiled, given = compile_learner(task, learner, mesh), {"seed": 1, "settings": {"learner": name}}
    half, whole = folder / "half" / name, Goal(2 * learner.steps)
    if not half.exists():
        half.mkdir(parents=True)
        learn(compiled, goal=Goal(learner.steps), directory=half, **given)
    copy = shutil.copytree(half, folder / f"{name}-{sys.argv[2]}")
    runs = [
        learn(compiled, goal=whole, **given),
        learn(compiled, goal=whole, directory=copy, resume=True, **given),
    ]
    return [(run.parameters, [record.distance for record in run.records]) for run in runs]


def ratio_of_masses(task, mesh):
    """Found from three motions, which neither two nor four devices divide."""
    x0 = jnp.asarray([1.0, 1.1, 0.9])[:, None, None] * task.scene.params.rest
    controls = jnp.broadcast_to(jnp.asarray([0.6, 0.9])[:, None], (3, 2, 1))
    motions = ObservedMotions(x0, jnp.zeros_like(x0), controls, jnp.broadcast_to(x0[:, None], (3, 2, 4, 2)))

    def params_of(ratio):
        return task.scene.params._replace(masses=ratio * task.scene.params.masses)

    found = identify(task.stepper, params_of, jnp.asarray(2.0), motions, iterations=2, mesh=mesh)
    assert found.iterations == 2
    return found.parameters, found.misfit


def value(mesh):
    """Parameters of a value, and what came of them on the way; six states do not divide among four."""
    found = fit_value(LINE, value_network(LINE, widths=()), numbers=FEW, double=True, mesh=mesh)
    return found.parameters, [(at.loss, at.validation) for at in found.history]


def main(folder, name):
    mesh, task = batch_mesh(), block()
    policy = make_policy(task, width=2)
    evolution = make_evolution_learner(task, policy, EvolutionSettings(pairs=2, generations=1), mesh=mesh)
    settings = GradientSettings(window=3, pairs=2, updates=1)
    found = {
        "evolution": walked(folder, "evolution", evolution, task, mesh),
        "gradient": walked(folder, "gradient", make_gradient_learner(task, policy, settings, mesh=mesh), task, mesh),
        "masses": ratio_of_masses(task, mesh),
        "value": value(mesh),
    }
    arrays = {
        f"{subject} {number}": np.asarray(leaf)
        for subject, results in found.items()
        for number, leaf in enumerate(jax.tree.leaves(results))
    }
    np.savez(folder / f"{name}.npz", devices=1 if mesh is None else mesh.size, **arrays)


if __name__ == "__main__":
    place, own_name, *process = sys.argv[1:]
    compilation._OPTIONS.clear()  # the tests' own are quicker
    jax.config.update("jax_enable_x64", True)
    if process:
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        jax.distributed.initialize(f"127.0.0.1:{process[1]}", 2, int(process[0]))
    main(Path(place), own_name)
