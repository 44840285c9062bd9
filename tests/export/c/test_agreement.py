"""Exported C equals jitted JAX on a thousand random states: of models of each kind, scenes, and Lagrangians by hand.

By default a few functions of a few systems are tried; `--every-export` tries all of everything, which takes minutes.
"""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
from comparison import BOUND, TYPES, in_c, in_jax
from compilers import needs_compiler
from conftest import slow_among
from jax import lax
from planar_arm import ARM
from test_families import MODELS, run_of, states_of

from dln_jax import joint_dissipation, tree_system
from dln_jax.export.c.load import FLAGS
from dln_jax.export.functions import functions_of_run, functions_of_system
from dln_jax.mechanics.friction import LAWS, coefficients_of
from dln_jax.mechanics.joint_friction import Load, with_friction
from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.scenes.registry import SCENES

STATES = 1000


def ball_in_a_bowl(q, qd):
    """The bowl's height is a series, and its slope is solved for with the bowl's metric."""
    height = lax.fori_loop(0, 4, lambda k, total: 0.3 * total * (q @ q) + 0.5 * q @ q, 0.0)
    slope = jax.grad(lambda q: jnp.tanh(q @ q))(q)
    metric = jnp.eye(2) + jnp.outer(slope, slope)
    return 0.5 * qd @ metric @ qd - 9.81 * height - 0.1 * slope @ jnp.linalg.solve(metric, slope)


def with_every_friction():
    """An arm with all laws of friction in its joints, also that of the force which a transmission carries."""
    coefficients = {name: np.array([0.2, 0.1]) for name in coefficients_of(LAWS)}
    dissipation = joint_dissipation(**coefficients, velocity_scale=0.02)
    return with_friction(tree_system(ARM), dissipation, Load(np.array([0.2, 0.1]), 0.02))


BY_HAND = {
    "ball_in_a_bowl": (LagrangianSystem(ball_in_a_bowl), 2),
    "every_friction": (with_every_friction(), 2),
}
"""With their degrees of freedom."""
SLOW = ("structured-delan", "black-box-hnn", "every_friction")
DEFAULT = ("trigonometric", "differential-network", "pendulum", *BY_HAND, *SLOW[:2])
"""The other cases repeat what is in these."""
BRIEFLY = ("inverse_dynamics", "forward_dynamics", "inverse_dynamics_jacobian", "mass_matrix", "rates", "hamiltonian")
WHOLE = ("pendulum", "differential-network")
SINGLE = ("structured-delan", "differential-network", "ball_in_a_bowl")
AS_USERS_DO = {"trigonometric": FLAGS}
TOO_LARGE = {f"chain-{links}" for links in range(7, 13)}
"""Their C takes minutes to compile."""


def pytest_generate_tests(metafunc):
    every = [case for case in (*MODELS, *SCENES, *BY_HAND) if case not in TOO_LARGE]
    chosen = every if metafunc.config.getoption("--every-export") else DEFAULT
    metafunc.parametrize("case", slow_among(chosen, SLOW.__contains__))


def system_of(case, precision):
    """Functions, the system that they are of, and its degrees of freedom."""
    if case in MODELS:
        run = run_of(case)
        functions = functions_of_run(run, precision=precision)
        needs = MODELS[case].get("needs")
        return functions, needs and run.energies, needs.degrees_of_freedom if needs else 1
    if case in BY_HAND:
        system, d, actuation = (*BY_HAND[case], None)
    else:
        scene = SCENES[case]()
        system, d, actuation = scene.closed_form, len(scene.needs.joints), scene.needs.actuation
    return functions_of_system(system, d, dtype=TYPES[precision], actuation=actuation), system, d


def with_holes(rows):
    """The states, and the first with each of its numbers in turn not finite."""
    first, changed = rows[0], []
    for place, leaf in enumerate(first):
        for k in range(np.size(leaf)):
            for value in (np.nan, np.inf, -np.inf):
                hole = np.where(np.arange(np.size(leaf)).reshape(np.shape(leaf)) == k, value, leaf)
                changed.append((*first[:place], hole, *first[place + 1 :]))
    return [*rows, *changed]


def differences(got, expected):
    """Returns the largest difference of each result over its largest number, where both are finite."""
    worst = {}
    for name, results in expected.items():
        for place, (ours, theirs) in enumerate(zip(got[name], results, strict=True)):
            finite = np.isfinite(theirs)
            # An implicit step is NaN where its iterations do not suffice.
            assert finite[:STATES].mean() > (0.3 if "implicit" in name else 0.99), name
            # Terms that cancel exactly leave round-off.
            scale = np.abs(theirs[:STATES][finite[:STATES]]).max(initial=0.1)
            finite &= np.isfinite(ours)
            apart = np.abs(ours[finite] - theirs[finite]) / np.maximum(scale, np.abs(theirs[finite]))
            worst[name, place] = apart.max(initial=0)
    return worst


@needs_compiler
def test_c_equals_jax(case, tmp_path, pytestconfig):
    every = pytestconfig.getoption("--every-export")

    def chosen(precision):
        functions, system, d = system_of(case, precision)
        names = functions if every or case in WHOLE else ("forward_dynamics",) if case in BY_HAND else BRIEFLY
        if case == "black-box-hnn" and not every:  # derivatives through its iterations take long to compile
            names = ("inverse_dynamics", "forward_dynamics", "rates", "hamiltonian")
        return {name: functions[name] for name in functions if name in names}, system, d

    functions, system, d = chosen("f64")
    controls = len(functions["step_rk4"][1][1]) if "step_rk4" in functions else d
    drawn = states_of(system, d, controls, count=STATES)
    states = {}
    for name, (function, examples) in functions.items():
        keys = inspect.signature(function).parameters
        if system is None:  # networks alone
            random = np.random.default_rng(1)
            drawn = {key: random.uniform(-1, 1, (STATES, *one.shape)) for key, one in zip(keys, examples, strict=True)}
            drawn = {key: values.astype(np.float32).astype(float) for key, values in drawn.items()}
        states[name] = with_holes(list(zip(*(drawn[key] for key in keys), strict=True)))
    expected = in_jax(functions, states)
    for precision in BOUND if every or case in SINGLE else ("f64",):
        ours = functions if precision == "f64" else chosen(precision)[0]
        got = in_c(ours, states, tmp_path / precision, precision=precision, flags=AS_USERS_DO.get(case, ("-O0",)))
        alike = expected if precision == "f64" else in_jax(ours, states, precision=precision)
        # Badly conditioned functions lose more digits, in JAX as well.
        rounding = differences(alike, expected)
        for name, apart in differences(got, expected).items():
            assert apart < max(BOUND[precision], 2 * rounding[name]), (precision, name, apart, rounding[name])
        for name, results in alike.items():
            for mine, theirs in zip(got[name], results, strict=True):
                other = np.unique(np.argwhere(np.isfinite(mine) != np.isfinite(theirs))[:, 0])
                if precision == "f32" and "implicit" in name and (other < STATES).sum() < 0.02 * STATES:
                    other = other[other >= STATES]  # whether iterations suffice is a matter of rounding there
                assert not other.size, (precision, name, [states[name][k] for k in other[:3]])
