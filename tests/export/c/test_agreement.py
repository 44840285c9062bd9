"""Exported C equals jitted JAX on a thousand random states: of models of each kind, scenes, and Lagrangians by hand.

By default a few functions of each are tried, and of a few systems all and single precision; `--every-export` tries all
of everything, which takes minutes.
"""

import inspect
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from comparison import BOUND, in_c, in_jax
from conftest import slow_among
from jax import lax
from test_families import MODELS, run_of

from dln_jax.export.c.families import functions_of_run, functions_of_system
from dln_jax.export.c.load import FLAGS
from dln_jax.mechanics.equations import Canonical, flow
from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.scenes.registry import SCENES
from dln_jax.zoo.run import Run

needs_compiler = pytest.mark.skipif(
    not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="there is no C compiler on the PATH"
)
STATES = 1000


def double_pendulum(q, qd):
    """From Cartesian positions of the masses as a function of the angles, and their velocities by a jvp."""

    def positions(q):
        steps = jnp.stack([jnp.sin(q), -jnp.cos(q)], axis=1) * jnp.array([[1.0], [0.7]], q.dtype)
        return jnp.cumsum(steps, axis=0)

    x, v = jax.jvp(positions, (q,), (qd,))
    return jnp.sum(jnp.array([[1.2], [0.8]], q.dtype) * (0.5 * v**2)) - 9.81 * jnp.sum(x[:, 1] * jnp.array([1.2, 0.8]))


def spherical_pendulum(q, qd):
    return 0.5 * (qd[0] ** 2 + jnp.sin(q[0] + 1.5) ** 2 * qd[1] ** 2) + 9.81 * jnp.cos(q[0] + 1.5)


def bead_on_a_hoop(q, qd):
    """On one that turns at a given rate; friction-free stops are a potential on one side."""
    stop = jnp.where(jnp.abs(q[0]) > 0.5, 40 * (jnp.abs(q[0]) - 0.5) ** 2, 0.0)
    return 0.5 * (qd[0] ** 2 + (1.7 * jnp.sin(q[0])) ** 2) + 9.81 * jnp.cos(q[0]) - stop


def spring_pendulum(q, qd):
    length, rate = 1.5 + q[0], qd[0]
    kinetic = 0.5 * (rate**2 + (length * qd[1]) ** 2)
    return kinetic + 9.81 * length * jnp.cos(q[1]) - 20 * q[0] ** 2 * lax.cond(q[0] > 0, lambda: 1.0, lambda: 2.0)


def relativistic_particle(q, qd):
    return -jnp.sqrt(1 - 0.1 * qd @ qd) / 0.1 - 0.5 * jnp.sum(q**2 * jnp.arange(1.0, 4.0))


def kepler(q, qd):
    r = 2 + q[0]
    return 0.5 * (qd[0] ** 2 + r**2 * qd[1] ** 2) + 1 / r


def charged_particle(q, qd):
    """In a magnetic field that grows with z, a potential that depends on the velocity."""
    vector = jnp.cross(jnp.array([0.0, 0.0, 1.0]) * (1 + q[2] ** 2), q) / 2
    return 0.5 * qd @ qd + qd @ vector - jnp.exp(-q @ q)


def furuta_pendulum(q, qd):
    sin, cos = jnp.sin(q[1]), jnp.cos(q[1])
    mass = jnp.array([[1.0, 0.0], [0.0, 0.2]]) + jnp.array([[0.2, 0.0], [0.0, 0.0]]) * sin**2
    mass = mass.at[0, 1].set(0.3 * cos).at[1, 0].set(0.3 * cos)
    factor = jnp.linalg.cholesky(mass)
    return 0.5 * jnp.sum((factor.T @ qd) ** 2) - 0.2 * 9.81 * cos


def elastic_beam(q, qd):
    """Masses in a row whose bending energy is summed by a scan."""
    padded = jnp.concatenate([jnp.zeros(2), q])

    def bent(energy, three):
        return energy + 30 * (three[0] - 2 * three[1] + three[2]) ** 2, None

    threes = jnp.stack([padded[:-2], padded[1:-1], padded[2:]], axis=1)
    energy, _ = lax.scan(bent, 0.0, threes)
    return 0.5 * qd @ qd - energy - 9.81 * jnp.sum(q)


def ball_in_a_bowl(q, qd):
    """The bowl's height is a series, and its slope is solved for with the bowl's metric."""
    height = lax.fori_loop(0, 4, lambda k, total: 0.3 * total * (q @ q) + 0.5 * q @ q, 0.0)
    slope = jax.grad(lambda q: jnp.tanh(q @ q))(q)
    metric = jnp.eye(2) + jnp.outer(slope, slope)
    return 0.5 * qd @ metric @ qd - 9.81 * height - 0.1 * slope @ jnp.linalg.solve(metric, slope)


LAGRANGIANS = {
    double_pendulum: 2,
    spherical_pendulum: 2,
    bead_on_a_hoop: 1,
    spring_pendulum: 2,
    relativistic_particle: 3,
    kepler: 2,
    charged_particle: 3,
    furuta_pendulum: 2,
    elastic_beam: 5,
    ball_in_a_bowl: 2,
}
"""With their degrees of freedom."""
BY_HAND = {lagrangian.__name__: (lagrangian, d) for lagrangian, d in LAGRANGIANS.items()}
CASES = [*MODELS, *SCENES, *BY_HAND]
DEFAULT = {"structured-delan", "black-box-hnn", "trigonometric", "feed-forward", "differential-network", "latent-phase"}
DEFAULT |= {*BY_HAND, "pendulum", "three-body"}
"""The other cases repeat what is in these."""
SLOW = {"black-box-hnn", "latent-phase", "three-body", "spherical_pendulum", "relativistic_particle", "kepler"}
SLOW |= {"structured-delan", "double_pendulum"}
"""Cases of `DEFAULT` whose primitives occur in another case, too."""
BRIEFLY = ("inverse_dynamics", "forward_dynamics", "inverse_dynamics_jacobian", "mass_matrix")
BRIEFLY += ("rates", "hamiltonian", "encode", "decode")
HAMILTONIANS = ("black-box-hnn",)
"""Their Newton iterations take long to compile: derivatives through them are tried with `--every-export`."""
WHOLE = ("pendulum", "differential-network")
SINGLE = ("structured-delan", "differential-network", "double_pendulum")
AS_USERS_DO = {"trigonometric": FLAGS}
LARGEST_CHAIN = 6


def system_of(case, precision):
    """Functions, and the system that they are of, if it is one of mechanics.

    A run's parameters are numbers that both precisions have.
    """
    dtype = {"f64": np.float64, "f32": np.float32}[precision]
    if case in MODELS:
        run = run_of(case)
        rounded = jax.tree.map(lambda leaf: leaf.astype(np.float32).astype(float), run.parameters)
        run = Run(run.model, rounded, run.description)
        return functions_of_run(run, precision=precision), run.energies if "needs" in MODELS[case] else None
    if case in BY_HAND:
        lagrangian, d = BY_HAND[case]
        system = LagrangianSystem(lagrangian)
        return functions_of_system(system, d, dtype=dtype), system
    scene = SCENES[case]()
    d = len(scene.needs.joints)
    return functions_of_system(scene.closed_form, d, dtype=dtype, actuation=scene.needs.actuation), scene.closed_form


def states_of(functions, system):
    """Returns a thousand states of each function, and the first with each of its numbers in turn not finite."""
    random = np.random.default_rng(1)
    drawn: dict[str, np.ndarray] = {}
    states = {}
    for function, examples in functions.values():
        arguments = list(inspect.signature(function).parameters)
        for key, example in zip(arguments, examples, strict=True):
            values = random.uniform(-1, 1, (STATES, *np.shape(example)))
            drawn.setdefault(key, (0.02 + 0 * values if key == "dt" else values).astype(np.float32).astype(float))
    if isinstance(system, Canonical):  # velocities that have momenta
        rates = jax.jit(jax.vmap(lambda q, p: flow(system).rates(q, p)[0]))
        drawn["qd"] = np.asarray(rates(drawn["q"], 0.5 * drawn["p"])).astype(np.float32).astype(float)
        drawn["x"] = np.concatenate([drawn["q"], drawn["qd"]], axis=1)
    for name, (function, _) in functions.items():
        columns = [drawn[key] for key in inspect.signature(function).parameters]
        every = list(zip(*columns, strict=True))
        first = every[0]
        for place, leaf in enumerate(first):
            for k in range(np.size(leaf)):
                for value in (np.nan, np.inf, -np.inf):
                    changed = np.array(leaf, copy=True)
                    changed.reshape(-1)[k] = value
                    every.append((*first[:place], changed, *first[place + 1 :]))
        states[name] = every
    return states


def differences(got, expected):
    """Returns the largest difference of each result over its largest number, where both are finite."""
    worst = {}
    for name, results in expected.items():
        for place, (ours, theirs) in enumerate(zip(got[name], results, strict=True)):
            finite = np.isfinite(theirs)
            # An implicit step is NaN where its iterations do not suffice.
            assert finite[:STATES].mean() > (0.3 if "implicit" in name else 0.99), name
            # Of what cancels exactly, round-off is left.
            scale = np.abs(theirs[:STATES][finite[:STATES]]).max(initial=0.1)
            finite &= np.isfinite(ours)
            apart = np.abs(ours[finite] - theirs[finite]) / np.maximum(scale, np.abs(theirs[finite]))
            worst[name, place] = apart.max(initial=0)
    return worst


def differently_finite(got, expected):
    """States where only one of the two results is finite, by result."""
    return {
        (name, place): np.unique(np.argwhere(np.isfinite(ours) != np.isfinite(theirs))[:, 0])
        for name, results in expected.items()
        for place, (ours, theirs) in enumerate(zip(got[name], results, strict=True))
    }


@needs_compiler
@pytest.mark.parametrize("case", slow_among(CASES, SLOW.__contains__))
def test_c_equals_jax(case, tmp_path, pytestconfig):
    every = pytestconfig.getoption("--every-export")
    if not every and case not in DEFAULT:
        pytest.skip("compared only with --every-export, which takes minutes")
    if case.startswith("chain") and int(case.removeprefix("chain-")) > LARGEST_CHAIN:
        pytest.skip("this export takes minutes to compile")

    def chosen(precision):
        functions, system = system_of(case, precision)
        names = functions if every or case in WHOLE else ("forward_dynamics",) if case in BY_HAND else BRIEFLY
        if case in HAMILTONIANS and not every:
            names = [name for name in names if name not in ("inverse_dynamics_jacobian", "mass_matrix")]
        return {key: function for key, function in functions.items() if key in names}, system

    functions, system = chosen("f64")
    states = states_of(functions, system)
    expected = in_jax(functions, states)
    for precision, bound in BOUND.items():
        if precision == "f32" and not (every or case in SINGLE):
            continue
        ours = functions if precision == "f64" else chosen(precision)[0]
        got = in_c(ours, states, tmp_path / precision, precision=precision, flags=AS_USERS_DO.get(case, ("-O0",)))
        alike = expected if precision == "f64" else in_jax(ours, states, precision=precision)
        # Badly conditioned functions lose more digits, in JAX as well.
        rounding = differences(alike, expected)
        for name, apart in differences(got, expected).items():
            assert apart < max(bound, 2 * rounding[name]), (precision, name, apart, rounding[name])
        for name, other in differently_finite(got, alike).items():
            if precision == "f32" and "implicit" in name[0] and (other < STATES).sum() < 0.02 * STATES:
                other = other[other >= STATES]  # whether iterations suffice is a matter of rounding there
            assert not other.size, (precision, name, [states[name[0]][k] for k in other[:3]])
