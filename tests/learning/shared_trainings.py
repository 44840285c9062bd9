"""Results of trainings on the devices that JAX sees: `shared_trainings.py FOLDER NAME [PROCESS PORT]`.

Writes FOLDER/NAME.npz and FOLDER/NAME.json. The first run leaves in FOLDER/half what it has trained half way, and every
run continues it.
"""

import contextlib
import itertools
import json
import shutil
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
from sharing import begun

from dln_jax.data.schema import Trajectories
from dln_jax.learning.engine import fit as engine
from dln_jax.learning.engine.checkpoint import Checkpoint, identity
from dln_jax.learning.engine.fit import fit
from dln_jax.learning.engine.optimisers import Adam, GaussNewton
from dln_jax.learning.engine.problem import Problem, mean_square, unmonitored
from dln_jax.scale.mesh import batch_mesh, of_first_process
from dln_jax.scenes.pendulums import pendulum
from dln_jax.solvers import levenberg_marquardt
from dln_jax.types import InputError
from scripts.reports.predictions import predictions

SAMPLES = 61
"""Which neither two nor four devices divide."""
START = (np.array([0.5, 1.0, -0.7]), np.array([-1.0, 0.1, 0.8]))
NEWTON = GaussNewton(5, coarse_steps=3, coarse_samples=22, steps_per_dispatch=2)
ADAM = Adam(steps=36, batch=20, steps_per_dispatch=9)


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


TRAININGS = {
    "newton": (1, NEWTON),
    "newton of three seeds": (3, NEWTON._replace(coarse_steps=0)),
    "adam": (1, ADAM),
    "adam of four seeds": (4, ADAM),
}
"""Seeds, and how they are trained."""
CONTINUED = ("newton", "adam of four seeds")
LONG = 1e6
"""s, of the clock of the first process; others are ahead of it."""


class Interruption(Exception):
    pass


class Compilations:
    """How many programs were compiled so far."""

    def __init__(self):
        self.count = 0
        jax.monitoring.register_event_duration_secs_listener(self.add)

    def add(self, name, *_, **__):
        self.count += name == "/jax/core/compile/backend_compile_duration"


def numbers(training):
    """All that decides."""
    return training.parameters, [(at.step, at.loss, at.validation) for at in training.history], training.best_step


def continued(folder, name, mesh):
    """A run that ends after two dispatches, and is continued, perhaps on other devices."""
    seeds, optimiser = TRAININGS[name]
    given = bumps(seeds)
    half = folder / "half" / name
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
    copy = shutil.copytree(half, folder / f"{name}, {sys.argv[2]}")
    return fit(given, optimiser, checkpoint=Checkpoint(copy, known, resume=True), mesh=mesh)


def recomputed(mesh):
    """Gauss-Newton whose Jacobian is not kept."""
    kept, levenberg_marquardt.KEPT_BYTES = levenberg_marquardt.KEPT_BYTES, 0
    try:
        return fit(bumps(), GaussNewton(3), mesh=mesh)
    finally:
        levenberg_marquardt.KEPT_BYTES = kept


def predicted(mesh):
    """Predictions of a pendulum's energies for seven states."""
    states = [np.random.default_rng(seed).normal(size=(7, 1)) for seed in range(4)]
    data = Trajectories(np.arange(7.0), *states, np.zeros(7, int), np.array(["fall"]))
    return predictions(pendulum().energies, data, jnp.float64, mesh=mesh)


def refusals(mesh):
    """The lines that are said of what cannot be shared."""
    of_batch = {"residual": None, "loss": lambda parameters, batch: jnp.var(batch[0]), "loss_is_mean": False}
    lines = []
    for given, optimiser in ((bumps(), ADAM._replace(batch=19)), (bumps()._replace(**of_batch), ADAM)):
        try:
            fit(given, optimiser, mesh=mesh)
        except InputError as error:
            lines.append(str(error))
    return lines


def main(folder, name):
    mesh = batch_mesh()
    if jax.process_index() > 0:
        ticks = itertools.count(0, 10 * int(LONG))
        engine.time = SimpleNamespace(perf_counter=lambda: float(next(ticks)))
    of_first_process(True, mesh)  # is a program of its own
    compilations, counts, found = Compilations(), {}, {}
    for key, (seeds, optimiser) in TRAININGS.items():
        after = []
        report = lambda at, after=after: after.append(compilations.count)  # noqa: E731
        training = fit(bumps(seeds), optimiser, report=report, seconds=LONG, mesh=mesh)
        found[key], counts[key] = numbers(training), np.diff(after).tolist()
    found |= {f"{key}, continued": numbers(continued(folder, key, mesh)) for key in CONTINUED}
    found["newton, recomputed"] = numbers(recomputed(mesh))
    found["predictions"] = predicted(mesh)
    said = {"devices": 1 if mesh is None else mesh.size, "compilations": counts, "refusals": refusals(mesh)}
    arrays = {
        f"{subject}: {number}": np.asarray(leaf)
        for subject, results in found.items()
        for number, leaf in enumerate(jax.tree.leaves(results))
    }
    np.savez(folder / f"{name}.npz", **arrays)
    (folder / f"{name}.json").write_text(json.dumps(said))


if __name__ == "__main__":
    main(*begun()[:2])
