"""Results of trainings on the devices that JAX sees: `shared_trainings.py FOLDER NAME [PROCESS PORT]`.

Writes FOLDER/NAME.npz and FOLDER/NAME.json. The first run leaves in FOLDER/half what it has trained half way, and every
run continues it.
"""

import contextlib
import itertools
import json
import shutil
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
from sharing import begun

from dln_jax.learning.engine import fit as engine
from dln_jax.learning.engine.checkpoint import Checkpoint, identity
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import Adam, GaussNewton
from dln_jax.learning.engine.problem import Problem, mean_square, unmonitored
from dln_jax.scale import batch_mesh, of_first_process, spread
from dln_jax.solvers.elimination import cholesky, solve, symmetric_eigen
from dln_jax.types import InputError

SAMPLES = 61
"""Which neither two nor four devices divide."""
START = (np.array([0.5, 1.0, -0.7]), np.array([-1.0, 0.1, 0.8]))
ADAM = Adam(steps=27, batch=20, steps_per_dispatch=9)
TRAININGS = {
    "newton": (1, GaussNewton(5, coarse_steps=3, coarse_samples=22, steps_per_dispatch=2)),
    "newton of three seeds": (3, GaussNewton(5, steps_per_dispatch=2)),
    "adam of four seeds": (4, ADAM),
}
"""Seeds, and how they are trained."""
LONG = 1e6
"""s, of the clock of the first process; others are ahead of it."""


class Interruption(Exception):
    pass


def bumps(seeds=1):
    """A sum of tanh on random places; every third one selects. Seeds start apart."""
    x = jax.random.uniform(jax.random.key(1), (SAMPLES,), minval=-2.0, maxval=2.0)
    arrays = (x, jnp.sin(2 * x))

    def residual(parameters, x, y):
        heights, places = parameters
        return heights @ jnp.tanh(x - places) - y

    def score(parameters):
        held_out = tuple(array[::3] for array in arrays)
        return unmonitored(mean_square(lambda *sample: residual(parameters, *sample), held_out))

    if seeds == 1:
        return Problem(residual, jax.tree.map(jnp.asarray, START), arrays, score)
    several = jax.tree.map(lambda leaf: jnp.stack([(1 + 0.1 * seed) * leaf for seed in range(seeds)]), START)
    return Problem(residual, several, arrays, score, jnp.arange(seeds))


def numbers(training):
    """All that decides."""
    return training.parameters, [(at.step, at.loss, at.validation) for at in training.history], training.best_step


def continued(folder, key, name, mesh):
    """A run that ends after two dispatches, and is continued, perhaps on other devices."""
    seeds, optimiser = TRAININGS[key]
    given, half = bumps(seeds), folder / "half" / key
    known = identity(optimiser, given.arrays)
    if not half.exists():
        half.mkdir(parents=True)

        def break_(at):
            seen.append(at)
            if len(seen) == 2:
                raise Interruption

        seen = []
        with contextlib.suppress(Interruption):
            fit(given, optimiser, checkpoint=Checkpoint(half, known), report=break_, mesh=mesh)
    copy = shutil.copytree(half, folder / f"{key}, {name}")
    return fit(given, optimiser, checkpoint=Checkpoint(copy, known, resume=True), mesh=mesh)


def factors(matrix):
    """By LAPACK, which takes a batch apart on a CPU."""
    return cholesky(matrix), symmetric_eigen(matrix), solve(matrix, matrix[0])


def main(folder, name):
    mesh = batch_mesh()
    if jax.process_index() > 0:
        ticks = itertools.count(0, 10 * int(LONG))
        engine.time = SimpleNamespace(perf_counter=lambda: float(next(ticks)))
    of_first_process(True, mesh)  # is a program of its own
    found = {}
    for key, (seeds, optimiser) in TRAININGS.items():
        found[key] = numbers(fit(bumps(seeds), optimiser, seconds=LONG, mesh=mesh))
        if key != "newton of three seeds":
            found[f"{key}, continued"] = numbers(continued(folder, key, name, mesh))
    matrices = np.random.default_rng(0).normal(size=(8, 17, 17))
    matrices = matrices @ matrices.swapaxes(1, 2)
    found["factors"] = jax.jit(spread(lambda _, batch: jax.vmap(factors)(batch), mesh))(0.0, matrices)
    said = {"devices": 1 if mesh is None else mesh.size, "refusal": ""}
    try:
        fit(bumps(), ADAM._replace(batch=19), mesh=mesh)
    except InputError as error:
        said["refusal"] = str(error)
    leaves = {key: jax.tree.leaves(results) for key, results in found.items()}
    np.savez(folder / f"{name}.npz", **{f"{key}: {k}": leaf for key in leaves for k, leaf in enumerate(leaves[key])})
    (folder / f"{name}.json").write_text(json.dumps(said))


if __name__ == "__main__":
    main(*begun()[:2])
