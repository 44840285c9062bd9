"""Exports of each kind of model and of scenes: values of the dynamics, and derivatives of those values."""

import functools
import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from conftest import slow_among
from jax import lax

from dln_jax.export.functions import functions_of_run, functions_of_system
from dln_jax.mechanics import integrators
from dln_jax.mechanics.dynamics import Dynamics, InverseForward, PhaseRates
from dln_jax.mechanics.equations import Canonical, dynamics, flow
from dln_jax.mechanics.trees.description import serial, tree_to_json
from dln_jax.mechanics.trees.inertia import inertial_parameters
from dln_jax.scenes.pendulums import cart_pole, double_pendulum
from dln_jax.types import Needs
from dln_jax.zoo.catalogue import CATALOGUE
from dln_jax.zoo.descriptions import build, describe
from dln_jax.zoo.run import Run

MIXED = Needs(joints=("prismatic", "revolute"), friction=True, actuation=((1.0,), (0.5,)))
FREE = Needs(joints=("revolute", "revolute"), gravity=False)
BODIES = Needs(joints=("prismatic",) * 4)
SMALL = {"width": 4, "depth": 1}
SWING = Needs(joints=("revolute",), friction=True)
RODS = [inertial_parameters(1.0, [0.1, 0.2, 0.3], np.diag([0.2, 0.3, 0.4]))] * 2
CART = serial([np.eye(3)] * 2, [[0, 0, 0], [0, 0.1, 0]], RODS, joints=MIXED.joints, axes=[[1, 0, 0], [0, 1, 0]])
CONVEX = {**SMALL, "activation": "softplus", "iterations": 8}
MODELS = {
    "structured-delan": {"needs": MIXED, **SMALL},
    "black-box-delan": {"needs": MIXED, **SMALL, "activation": "softplus"},
    "trigonometric": {"needs": FREE, "degree": 1},
    "trigonometric-kernel": {"needs": MIXED, "samples": 3},
    "rigid-tree": {"needs": MIXED, "tree": tree_to_json(CART)},
    "rigid-tree-residual": {
        **{"needs": MIXED, "tree": tree_to_json(CART), "terms": ("potential", "dissipation", "inertia"), **SMALL},
    },
    "trigonometric-residual": {"needs": FREE, "degree": 1, **SMALL},
    "trigonometric-kernel-residual": {"needs": MIXED, "samples": 3, **SMALL},
    "planar-chain": {"needs": FREE._replace(gravity=True, friction=True), "armature": True},
    "learned-tree": {"needs": MIXED._replace(actuation=None)},
    "feed-forward": {"needs": MIXED, "width": 4, "depth": 2},
    "structured-hnn": {"needs": MIXED, **SMALL, "friction_width": 2},
    "black-box-hnn": {"needs": MIXED, **CONVEX},
    "separable-hnn": {"needs": SWING, **CONVEX},
    "pairwise-hnn": {"needs": BODIES, **SMALL},
    "polynomial-hamiltonian": {"needs": SWING._replace(friction=False), "degree": 2},
    "phase-network": {"needs": FREE, **SMALL},
    "helmholtz-hnn": {"needs": FREE, **SMALL},
    "differential-network": {"sizes": [2, 4, 3], "activation": "tanh", "members": 2},
    "latent-phase": {"field": "black-box-hnn", "pixels": 6, "components": 2, "width": 3, "field_width": 3},
}
DT = 0.02


def run_of(name):
    """A model whose parameters no initialisation would give, as biases are not zero, and both precisions have."""
    description = describe(name, precision="f64", **MODELS[name])
    model, random = build(description), np.random.default_rng(3)

    def drawn(path, leaf):
        values = 0.4 * random.normal(size=leaf.shape)
        # Convex in its inputs, so that mass matrices are definite and each velocity has a momentum.
        convex = MODELS[name].get("activation") == "softplus" and "linear_0" not in str(path) and len(leaf.shape) == 2
        return jnp.asarray(np.abs(values) + 0.1 if convex else values, leaf.dtype)

    if CATALOGUE[name].properties.linear and not CATALOGUE[name].properties.canonical:  # starts from a definite M
        parameters = jax.tree.map(
            lambda leaf: leaf + 0.02 * random.normal(size=leaf.shape), model.init(jax.random.key(0))
        )
    else:
        # Drawn here and not by `init`, which is slow to compile.
        parameters = jax.tree_util.tree_map_with_path(drawn, jax.eval_shape(model.init, jax.random.key(0)))
    return Run(model, jax.tree.map(lambda leaf: leaf.astype(np.float32).astype(leaf.dtype), parameters), description)


def states_of(system, d, controls=1, count=3):
    """Values of each argument, by its name, that single precision has too."""
    random = np.random.default_rng(1)
    states = {name: random.uniform(-1, 1, (count, d)) for name in ("q", "qd", "qdd", "tau", "p")}
    states |= {"u": random.normal(size=(count, controls)), "dt": np.full(count, DT)}
    if isinstance(system, Canonical):  # velocities that have momenta
        rates = jax.jit(jax.vmap(lambda q, p: flow(system).rates(q, p)[0]))
        states["qd"] = rates(states["q"], 0.5 * states["p"])
    states["x"] = np.concatenate([states["q"], states["qd"]], axis=1)
    return {name: np.asarray(values).astype(np.float32).astype(float) for name, values in states.items()}


def definitions(system):
    """By the name of a function, what it is by the mechanics of the system."""
    expected = {}
    if not isinstance(system, PhaseRates):
        motion = dynamics(system)
        expected |= {
            "inverse_dynamics": lambda q, qd, qdd: {"tau": motion.inverse_dynamics(q, qd, qdd)},
            "forward_dynamics": lambda q, qd, tau: {"qdd": motion.forward_dynamics(q, qd, tau)},
            "gravity": lambda q: {"g": motion.decompose(q, 0 * q, 0 * q).gravity},
            "coriolis": lambda q, qd: {"c": motion.decompose(q, qd, 0 * q).coriolis},
        }
        if isinstance(motion, Dynamics):
            expected |= {
                "energy": lambda q, qd: {"energy": motion.energy(q, qd)},
                "mass_matrix": lambda q, qd: {"M": motion.mass_matrix(q, qd)},
                "friction": lambda q, qd: {"tau_friction": motion.friction(q, qd)},
            }
    if isinstance(system, Canonical | PhaseRates):
        moving = flow(system)
        expected["rates"] = lambda q, p: dict(zip(("qd", "pd"), moving.rates(q, p), strict=True))
        if isinstance(system, Canonical):
            expected["hamiltonian"] = lambda q, p: {"H": moving.energy(q, p)}
    return expected


def with_derivatives(name, expected, arguments):
    """A definition and its derivatives, by the names that they are exported under."""
    places = tuple(range(len(arguments)))
    differentiated = jax.jacfwd(lambda *state: (expected(*state),) * 2, argnums=places, has_aux=True)

    def derivatives(*state):
        slopes, _ = differentiated(*state)
        return {
            f"{result}_{key}": slope for result, by in slopes.items() for key, slope in zip(arguments, by, strict=True)
        }

    return {name: expected, f"{name}_jacobian": derivatives, f"{name}_gradient": derivatives}


def system_of(case):
    """Functions, the system that they are of, and its needs."""
    if case in MODELS:
        run = run_of(case)
        return functions_of_run(run, precision="f64"), run.energies, MODELS[case]["needs"]
    scene = {"cart-pole": cart_pole(friction=0.3), "double-pendulum": double_pendulum()}[case]
    closed = scene.closed_form
    return functions_of_system(closed, 2, dtype=float, actuation=scene.needs.actuation), closed, scene.needs


CASES = [*(name for name in MODELS if "needs" in MODELS[name]), "cart-pole"]
DEFAULT = ("black-box-delan", "black-box-hnn", "feed-forward", "phase-network", "cart-pole")
"""One of each type of record; the others by `--every-export`."""
HAMILTONIANS = ("black-box-hnn", "separable-hnn", "polynomial-hamiltonian")
"""Models of one record. Newton iterations take long to trace, so derivatives like those of others are left out."""


def pytest_generate_tests(metafunc):
    if "case" in metafunc.fixturenames:
        chosen = CASES if metafunc.config.getoption("--every-export") else DEFAULT
        metafunc.parametrize(
            "case", slow_among(chosen, (*HAMILTONIANS, "black-box-delan", "phase-network").__contains__)
        )


def test_functions_and_their_derivatives_are_those_of_the_mechanics(case):
    functions, system, needs = system_of(case)
    # As exported, traced once.
    system = system._replace(**{name: jax.jit(field) for name, field in system._asdict().items() if callable(field)})
    controls = len(needs.joints) if needs.actuation is None else len(needs.actuation[0])
    states = states_of(system, len(needs.joints), controls)
    expected = {}
    for name, function in definitions(system).items():
        arguments = list(inspect.signature(function).parameters)
        expected |= {
            key: (derivative, arguments) for key, derivative in with_derivatives(name, function, arguments).items()
        }
    tried = [name for name in functions if "step" not in name]
    if case in HAMILTONIANS:
        own = ("inverse", "forward", "rates", "hamiltonian")
        tried = [name for name in tried if name.startswith(own) or name in ("coriolis", "energy", "mass_matrix")]
    parameters = {name: list(inspect.signature(function).parameters) for name, (function, _) in functions.items()}
    for name, (_, examples) in functions.items():
        assert [(example.shape, example.dtype) for example in examples] == [
            (states[key][0].shape, "float64") for key in parameters[name]
        ]

    @jax.jit
    def everything(states):
        got = {name: jax.vmap(functions[name][0])(*(states[key] for key in parameters[name])) for name in tried}
        wanted = {name: jax.vmap(expected[name][0])(*(states[key] for key in expected[name][1])) for name in tried}
        return got, wanted

    got, wanted = everything(states)
    for name in tried:
        assert np.isfinite(jax.tree.leaves(wanted[name])[0]).all()
        for result, array in got[name].items():
            scale = max(1, np.abs(wanted[name][result]).max())
            np.testing.assert_allclose(array, wanted[name][result], rtol=0, atol=1e-10 * scale, err_msg=name)


def test_what_a_system_lacks_is_not_exported():
    lacking = {
        "structured-delan": set(),
        "trigonometric": {"gravity", "friction"},
        "feed-forward": {"energy", "mass_matrix", "friction"},
        "structured-hnn": set(),
        "phase-network": {"hamiltonian"},
        "pairwise-hnn": {"friction"},
        "double-pendulum": {"friction"},
    }
    for case, missing in lacking.items():
        functions, system, _ = system_of(case)
        kind = ["rates", "hamiltonian"] * isinstance(system, Canonical | PhaseRates)
        kind += ["gravity", "energy", "mass_matrix", "friction"] * (not isinstance(system, PhaseRates))
        assert {name for name in kind if name not in functions} == missing, case


def swing(q, p):
    """Rates of two coupled pendulums with friction."""
    return p, -jnp.sin(q) - 0.3 * p + 0.5 * q[::-1]


def accelerated(q, qd, tau):
    return (tau + swing(q, qd)[1]) / jnp.array([1.0, 2.0])


DRIVEN = InverseForward(lambda q, qd, qdd: qdd * jnp.array([1.0, 2.0]) - swing(q, qd)[1], accelerated)
FAST = jnp.array([1.0, 2.0, 20.0, -30.0])


@pytest.mark.parametrize("rule", ["rk4", "implicit_midpoint"])
def test_steps_and_their_linearisations_are_those_of_the_integrators(rule):
    """One force acts on both coordinates; a step of the phase space has none."""
    B = [[1.0], [-0.4]]
    driven = functions_of_system(DRIVEN, 2, dtype=float, actuation=B)[f"step_{rule}_jacobian"][0]
    free = functions_of_system(PhaseRates(swing), 2, dtype=float)[f"phase_step_{rule}_jacobian"][0]

    def stepped(rates, x):
        if rule == "rk4":
            return integrators.rk4(lambda t, x: rates(x))(0.0, x, DT)
        return lax.fori_loop(0, 12, lambda _, after: x + DT * rates((x + after) / 2), x)

    def by_rule(x, u):
        fields = (lambda q, qd: (qd, accelerated(q, qd, jnp.array(B) @ u)), swing)
        return [stepped(lambda x, rates=rates: jnp.concatenate(rates(*jnp.split(x, 2))), x) for rates in fields]

    @jax.jit
    def both(x, u, dt):
        q, p, *blocks = free(*jnp.split(x, 2), dt).values()
        ours = [*driven(x, u, dt).values(), jnp.concatenate([q, p]), jnp.block([blocks[:2], blocks[2:]])]
        after, rested = by_rule(x, u)
        slopes, free_slopes = jax.jacfwd(by_rule, argnums=(0, 1))(x, u)
        return ours, [after, *slopes, rested, free_slopes[0]]

    for ours, expected in zip(*both(0.1 * FAST, jnp.array([0.7]), DT), strict=True):
        np.testing.assert_allclose(ours, expected, rtol=0, atol=1e-10)


def test_a_step_that_is_not_found_is_nan():
    """Ten seconds of a fast pendulum; and a NaN in the state makes every result one."""
    step = jax.jit(functions_of_system(DRIVEN, 2, dtype=float)["step_implicit_midpoint"][0])
    assert jnp.isnan(step(FAST, jnp.zeros(2), 10.0)["x_next"]).all()
    assert jnp.isfinite(step(FAST, jnp.zeros(2), 0.001)["x_next"]).all()
    assert jnp.isnan(step(FAST.at[0].set(jnp.nan), jnp.zeros(2), 0.001)["x_next"]).all()


def test_a_differential_network_has_the_means_over_its_members():
    run, x = run_of("differential-network"), jnp.array([0.3, -0.8])
    functions = functions_of_run(run, precision="f64")
    expected = dict(zip(("y", "jacobian", "hessian"), run.derivatives(x), strict=True))
    assert list(functions) == ["value", "value_and_jacobian", "value_jacobian_hessian"]
    every = jax.jit(lambda x: [function(x) for function, _ in functions.values()])
    for count, got in enumerate(every(x), 1):
        assert list(got) == list(expected)[:count]
        for key, array in got.items():
            np.testing.assert_allclose(array, expected[key], rtol=1e-12)


def test_pictures_have_their_networks_and_the_rates_of_their_latent_phase():
    run = run_of("latent-phase")
    functions = functions_of_run(run, precision="f64")
    names = ("encode", "decode", "rates")
    assert {*names, "phase_step_rk4"} <= {*functions}

    @jax.jit
    def both(frames):
        q, p = run.images.encode(frames)
        states = ((frames,), (q, p), (q, p))
        ours = [[*functions[name][0](*state).values()] for name, state in zip(names, states, strict=True)]
        return ours, ((q, p), (run.images.decode(q, p),), run.images.field.rates(q, p))

    ours, by_hand = both(jnp.linspace(0, 1, 12))
    for got, expected in zip(jax.tree.leaves(ours), jax.tree.leaves(by_hand), strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-12)


def test_results_have_the_precision_that_is_asked_for():
    scene = cart_pole()
    functions = functions_of_system(scene.closed_form, 2, dtype=np.float32, actuation=scene.needs.actuation)
    for case in ("structured-delan", "differential-network"):
        functions |= {f"{case} {name}": pair for name, pair in functions_of_run(run_of(case), precision="f32").items()}
    for name, (function, examples) in functions.items():
        if not name.endswith("jacobian"):
            types = {leaf.dtype for leaf in jax.tree.leaves([examples, jax.eval_shape(function, *examples)])}
            assert types == {np.dtype(np.float32)}, name


def test_mistakes_are_named():
    run = run_of("structured-delan")
    assert list(functions_of_run(run, precision="f32", names=["gravity"])) == ["gravity"]
    own = Run(run.model, run.parameters, {**run.description, "name": "own"})
    large = Run(run.model, jax.tree.map(lambda leaf: leaf * 1e300, run.parameters), run.description)
    system = functools.partial(functions_of_system, run.energies, 2, dtype=float)
    cases = {
        "a structured-delan has no sped, value; choose from inverse_dynamics, ": lambda: functions_of_run(
            run, precision="f64", names=["sped", "gravity", "value"]
        ),
        "beyond the range of float32": lambda: functions_of_run(large, precision="f32"),
        "precision is 'f16'": lambda: functions_of_run(run, precision="f16"),
        "in its training precision, f64": lambda: functions_of_run(own, precision="f32"),
        "iterations is 0": lambda: system(iterations=0),
    }
    for message, call in cases.items():
        with one_line(message):
            call()
    assert {*MODELS} == {*CATALOGUE}
