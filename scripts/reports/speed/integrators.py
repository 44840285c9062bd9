"""benchmark integrators: steps per second against energy drift and trajectory error."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.learning.engine.optimisers import Adam
from dln_jax.mechanics import integrators
from dln_jax.mechanics.equations import hamiltonian_of
from dln_jax.mechanics.integrators import Step
from dln_jax.training.hamiltonian.model_selection import description_of
from dln_jax.training.hamiltonian.tasks import Problem, problem_of
from dln_jax.training.hamiltonian.training import train
from dln_jax.types import Hamiltonian
from dln_jax.zoo.descriptions import build
from scripts.reports.case import Findings
from scripts.reports.rows import Row
from scripts.reports.turns import medians_in_turns

SCENES = {"pendulum": 0.2, "double-pendulum": 0.04, "henon-heiles": 0.4, "two-body": 0.4}
"""Largest time step by scene, s; it is halved repeatedly."""
SEPARABLE = ("pendulum", "henon-heiles", "two-body")
HALVINGS = 6
POINTS = 26
"""Times for comparing states."""
MOTIONS = 16
"""Number of motions, from the first test starts, in one batch."""
METHODS = ("explicit-euler", "symplectic-euler", "stormer-verlet", "rk4", "implicit-midpoint", "gauss-legendre-4")
QUICK = ("stormer-verlet", "rk4")


def measure(quick: bool) -> Findings:
    """Integrates motions of all scenes by all integrators, halving dt; the truth is integrated to 1e-12 per step."""
    rows: list[Row] = []
    for scene in ("henon-heiles",) if quick else SCENES:
        problem = problem_of(scene, trajectories=20 if quick else 100 if scene == "two-body" else None)
        energies = {"exact": problem.energy, "learned": learned_energy(problem, quick=quick)}
        for kind, H in ((kind, H) for kind, H in energies.items() if H is not None):
            for method in QUICK if quick else METHODS:
                step = step_of(method, H, separable=scene in SEPARABLE)
                if step is None:
                    continue
                swept = sweep(problem, H, step, dt=SCENES[scene], halvings=2 if quick else HALVINGS)
                for dt, rate, drift, error in swept:
                    case = f"{scene}/{kind}/{method}/dt-{dt:.4g}"
                    rows += [
                        Row(case, "simulated_seconds_per_second", rate, "1"),
                        Row(case, "steps_per_second", rate / dt, "1/s"),
                        Row(case, "energy_drift", drift, "J"),
                        Row(case, "trajectory_error", error, "1"),
                    ]
    return Findings(rows)


def learned_energy(problem: Problem, *, quick: bool) -> Hamiltonian:
    """The energy of the model that suits the scene, trained as in the table of Hamiltonian tasks.

    A quick run takes a few steps of Adam, whose program compiles faster.
    """
    options = {"optimiser": Adam(), "steps": 50} if quick else {}
    trained = train(problem, description_of(problem, "auto"), seed=0, **options)
    return hamiltonian_of(build(trained.description).energies(trained.result.parameters))


def step_of(method: str, H: Hamiltonian, *, separable: bool) -> Step | None:
    """The integrator of a Hamiltonian; `None` if the method needs a separable energy and this one is not."""
    slope_q, slope_p = (jax.grad(H, argnums=argument) for argument in range(2))

    def field(t, state):
        q, p = state
        return slope_p(q, p), -slope_q(q, p)

    methods = {
        "explicit-euler": integrators.explicit_euler,
        "rk4": integrators.rk4,
        "implicit-midpoint": integrators.implicit_midpoint,
        "gauss-legendre-4": integrators.gauss_legendre4,
    }
    if method in methods:
        return methods[method](field)
    if not separable:
        return None
    if method == "symplectic-euler":
        return integrators.symplectic_euler(lambda t, q, p: slope_p(q, p), lambda t, q, p: -slope_q(q, p))
    # Both parts of a separable energy are evaluated with the other variable zero, on which they do not depend.
    return integrators.stormer_verlet(
        lambda t, p: slope_p(jnp.ones_like(p), p), lambda t, q: -slope_q(q, jnp.zeros_like(q))
    )


@functools.partial(jax.jit, static_argnames=("step",))
def motions(step: Step, states, t, substeps):
    """States [K, T - 1] after t[0]; the count of steps between them is traced, so that one program serves every dt."""

    def interval(state, times):
        start, end = times
        dt = (end - start) / substeps
        state = jax.lax.fori_loop(0, substeps, lambda index, state: step(start + index * dt, state, dt), state)
        return state, state

    return jax.vmap(lambda state: jax.lax.scan(interval, state, (t[:-1], t[1:]))[1])(states)


def sweep(
    problem: Problem, H: Hamiltonian, step: Step, *, dt: float, halvings: int
) -> list[tuple[float, float, float, float]]:
    """dt, simulated seconds per second, largest change of the system's own energy, and rms error of the states."""
    truth = problem.truth[0]
    chosen = np.linspace(0, len(truth.t) - 1, POINTS).astype(int)
    t, q, p = (jnp.asarray(array) for array in (truth.t[chosen], truth.q[:MOTIONS, chosen], truth.p[:MOTIONS, chosen]))
    energies = jax.jit(jax.vmap(jax.vmap(H)))
    start, began = (q[:, 0], p[:, 0]), energies(q[:, :1], p[:, :1])
    program = functools.partial(motions, step)
    swept = []
    for halving in range(halvings):
        substeps = max(1, round(float(t[1] - t[0]) / dt)) * 2**halving
        q_hat, p_hat = program(start, t, substeps)
        seconds = medians_in_turns({"motions": program}, (start, t, substeps), repetitions=3, warm_up=1)["motions"]
        drift = float(jnp.max(jnp.abs(energies(q_hat, p_hat) - began)))
        error = float(jnp.sqrt(jnp.mean(jnp.concatenate([q_hat - q[:, 1:], p_hat - p[:, 1:]], axis=2) ** 2)))
        if np.isfinite(drift) and np.isfinite(error):
            swept.append((float(t[1] - t[0]) / substeps, len(q) * float(t[-1] - t[0]) / seconds, drift, error))
    return swept
