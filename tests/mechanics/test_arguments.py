"""One type, one call: what dynamics of every origin take, what they refuse in one line, and what M is at rest."""

import functools
import inspect
import shutil
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.deploy.c.families import functions_of_system
from dln_jax.deploy.c.load import load_c
from dln_jax.deploy.c.source import export_c
from dln_jax.deploy.stablehlo import export_stablehlo
from dln_jax.mechanics import lagrangian
from dln_jax.mechanics.dynamics import Dynamics, PlainDynamics, PlainFlow
from dln_jax.mechanics.equations import dynamics, flow
from dln_jax.mechanics.hamiltonian import HamiltonianSystem
from dln_jax.mechanics.lagrangian import LagrangianSystem
from dln_jax.mechanics.natural import NaturalSystem
from dln_jax.mechanics.natural_hamiltonian import NaturalHamiltonian
from dln_jax.mechanics.plain import PhaseRates
from dln_jax.scenes.cart_pole import cart_pole
from dln_jax.types import InputError
from dln_jax.zoo.descriptions import build, describe
from dln_jax.zoo.run import load, save

SCENE = cart_pole(friction=0.1)


def description(kind):
    if kind == "polynomial-hamiltonian":
        return describe(kind, needs=SCENE.needs._replace(friction=False), precision="f64")
    size = {} if kind == "trigonometric" else {"width": 3, "depth": 1}
    return describe(kind, needs=SCENE.needs, precision="f64", **size)


@functools.cache
def parameters_of(kind):
    # Drawn here and not by `init`, which is slow to compile.
    draw = np.random.default_rng(0).normal
    return jax.tree.map(
        lambda leaf: jnp.asarray(draw(size=leaf.shape)), jax.eval_shape(build(description(kind)).init, KEY)
    )


KEY = jax.random.key(0)
FACTOR = np.array([[1.0, 0.0], [0.3, 2.0]])


def H(q, p):
    return jnp.sum(jnp.sqrt(1 + p**2)) + jnp.sum(q**2)


def network(kind):
    return lambda folder: dynamics(energies(kind), degrees_of_freedom=2)


def energies(kind):
    return build(description(kind)).energies(parameters_of(kind))


def loaded(kind):
    def load_again(folder):
        save(folder, description(kind), parameters_of(kind))
        return load(folder).dynamics

    return load_again


ORIGINS = {
    "scene": lambda folder: dynamics(SCENE.energies, degrees_of_freedom=2),
    "lagrangian": lambda folder: dynamics(SCENE.energies),
    "natural": lambda folder: dynamics(NaturalSystem(lambda q: jnp.cos(q[0]) * FACTOR)),
    "hamiltonian": lambda folder: dynamics(HamiltonianSystem(H)),
    "natural hamiltonian": lambda folder: dynamics(NaturalHamiltonian(lambda q: FACTOR + 0 * q[0])),
    **{kind: network(kind) for kind in ("structured-delan", "black-box-delan", "structured-hnn", "feed-forward")},
    **{
        f"loaded {kind}": loaded(kind)
        for kind in ("structured-delan", "black-box-delan", "feed-forward", "trigonometric")
    },
}
WITHOUT_SIZE = ("lagrangian", "natural", "hamiltonian", "natural hamiltonian")
FUNCTIONS = {
    "inverse_dynamics": ("q", "qd", "qdd"),
    "forward_dynamics": ("q", "qd", "tau"),
    "energy": ("q", "qd"),
    "mass_matrix": ("q", "qd"),
    "decompose": ("q", "qd", "qdd"),
    "friction": ("q", "qd"),
}
MALFORMED = {
    "batch": (np.zeros((5, 2)), r"has shape \(5, 2\); expected .*jax\.vmap"),
    "row": (np.zeros((1, 2)), r"has shape \(1, 2\)"),
    "number": (0.3, r"has shape \(\)"),
    "too few": ([1.0], r"has shape \(1,\)"),
    "too many": (np.zeros(4), r"has shape \(4,\)"),
    "none at all": (np.zeros(0), r"has shape \(0,\)"),
    "ragged": ([[0.1, 0.2], [0.3]], "is a list that makes no array; expected one vector"),
    "complex": (np.array([1j, 0]), "has type complex128"),
    "truth values": (np.array([True, False]), "has type bool"),
    "text": ("ab", "is a str that makes no array"),
    "nothing": (None, "is None; expected one vector"),
}


def asked(system):
    """The functions that a system has, with the names of their arguments."""
    for name, names in FUNCTIONS.items():
        if hasattr(system, name):
            yield name, getattr(system, name), names


@pytest.mark.parametrize("origin", ORIGINS)
def test_what_is_no_state_is_refused_by_name(origin, tmp_path):
    system = ORIGINS[origin](tmp_path)
    fine = np.array([0.3, 0.1])
    for _, function, names in asked(system):
        assert tuple(inspect.signature(function).parameters) == names
        for fault, (value, message) in MALFORMED.items():
            for place, argument in enumerate(names):
                # A callable alone does not say how many coordinates it has: q does.
                if place == 0 and fault in ("too few", "too many") and origin in WITHOUT_SIZE:
                    continue
                # Text does not get past the door of a jitted function, which JAX keeps; None is the rest.
                if (fault == "text" and origin.startswith("loaded")) or (fault, argument) == ("nothing", "qd"):
                    continue
                state = [value if index == place else fine for index in range(len(names))]
                with pytest.raises(InputError, match=f"^{argument} {message}") as caught:
                    function(*state)
                assert "\n" not in str(caught.value)


def test_sizes_that_differ_are_refused_where_none_is_known():
    system = dynamics(LagrangianSystem(lambda q, qd: jnp.sum(qd**2)))
    with pytest.raises(InputError, match=r"qd has shape \(3,\); expected \(2,\)"):
        system.energy([0.1, 0.2], [1, 2, 3])
    with pytest.raises(InputError, match=r"tau has shape \(1,\); expected \(2,\)"):
        jax.jit(system.forward_dynamics)(np.ones(2), np.ones(2), np.ones(1))


@pytest.mark.parametrize("origin", ORIGINS)
def test_whole_numbers_lists_and_mixed_types_are_converted(origin, tmp_path):
    system = ORIGINS[origin](tmp_path)
    given = {"q": (0, 1), "qd": [0.5, 0], "qdd": np.array([1, -2]), "tau": np.array([1, 2], np.float32), "p": [1, 0.5]}

    def answers(state):
        return {name: function(*(state[key] for key in names)) for name, function, names in asked(system)}

    arrays = {key: jnp.asarray(value, jnp.float64) for key, value in given.items()}
    assert jax.eval_shape(lambda: answers(given)) == jax.eval_shape(answers, arrays)
    if not isinstance(system, Dynamics) or origin == "hamiltonian":  # it takes seconds to compile
        return
    q, qd = arrays["q"], arrays["qd"]

    @jax.jit
    def numbers():
        mass = system.mass_matrix
        return (system.energy(given["q"], given["qd"]), mass(q=q)), (system.energy(q, qd), mass(given["q"], 0 * qd))

    jax.tree.map(lambda one, other: np.testing.assert_allclose(one, other, rtol=1e-12), *numbers())


def test_what_a_system_cannot_do_is_absent_from_its_type(tmp_path):
    for origin in ("feed-forward", "loaded feed-forward"):
        system = ORIGINS[origin](tmp_path)
        assert isinstance(system, PlainDynamics) and not hasattr(system, "energy")
    rates = PhaseRates(lambda q, p: (p, -q))
    assert isinstance(flow(rates), PlainFlow)
    with pytest.raises(InputError, match="dynamics got a PhaseRates; expected one of NaturalSystem, "):
        dynamics(rates)
    with pytest.raises(InputError, match="flow got a InverseForward; expected one of NaturalSystem, "):
        flow(energies("feed-forward"))


def test_the_edge_leaves_no_trace_in_a_program():
    """Arrays that fit pass through: no operation is added to a compiled function, in either type."""
    for dtype in (np.float32, np.float64):
        state = [np.ones(2, dtype)] * 3
        plain = jax.make_jaxpr(functools.partial(lagrangian.forward_dynamics, SCENE.lagrangian))(*state)
        checked = dynamics(LagrangianSystem(SCENE.lagrangian)).forward_dynamics
        assert str(jax.make_jaxpr(checked)(*state)) == str(plain)


FIELDS = {
    "energy": lambda folder: flow(HamiltonianSystem(H, lambda q, qd: jnp.sum(qd**2))),
    "structured": lambda folder: flow(energies("structured-hnn")),
    **{
        kind: lambda folder, kind=kind: flow(energies(kind))
        for kind in ("separable-hnn", "polynomial-hamiltonian", "phase-network")
    },
}


def loaded_field(folder):
    kind = "separable-hnn"
    save(folder, description(kind), parameters_of(kind))
    return load(folder).flow


@pytest.mark.parametrize("origin", [*FIELDS, "loaded"])
def test_a_phase_field_refuses_and_converts_likewise(origin, tmp_path):
    field = {**FIELDS, "loaded": loaded_field}[origin](tmp_path)
    fine = np.array([0.3, 0.1])
    names = ("q", "p")
    for function in field:
        for value, message in (MALFORMED[fault] for fault in ("batch", "number", "too few", "too many", "complex")):
            with pytest.raises(InputError, match=f"^{names[1]} {message}"):
                function(fine, value)
            if np.ndim(value) != 1:
                with pytest.raises(InputError, match=f"^q {message}"):
                    function(value, fine)
        got, expected = jax.jit(lambda f=function: (f((1, 0), [0.5, 1]), f(np.array([1.0, 0]), np.array([0.5, 1]))))()
        jax.tree.map(np.testing.assert_array_equal, got, expected)


@pytest.mark.skipif(not shutil.which("cc"), reason="there is no C compiler on the PATH")
@pytest.mark.parametrize("kind", ["structured-delan", "black-box-delan", "feed-forward"])
def test_exported_c_takes_and_refuses_what_the_model_does(kind, tmp_path):
    model, functions = network(kind)(tmp_path), functions_of_system(energies(kind), 2, dtype=float)
    calls = {"inverse_dynamics": ("q", "qd", "qdd"), "forward_dynamics": ("q", "qd", "tau")}
    if isinstance(model, Dynamics):
        calls |= {
            "energy": ("q", "qd"),
            "mass_matrix": tuple(inspect.signature(functions["mass_matrix"][0]).parameters),
        }
    export_c({name: functions[name] for name in calls}, tmp_path)
    system = load_c(tmp_path, flags=("-O0",))
    q, qd, x = [0.3, -0.2], [1, 0], np.array([0.5, 1.0], np.float32)
    expected = jax.jit(model.inverse_dynamics)(q, qd, x)
    np.testing.assert_allclose(system.inverse_dynamics(q, qd, x), expected, rtol=1e-10)
    np.testing.assert_allclose(system.inverse_dynamics(*map(np.asarray, (q, qd, x))), expected, rtol=1e-10)
    for name, names in calls.items():
        for fault, (value, message) in MALFORMED.items():
            message = message if "has shape" in message else "(has type|makes no array|is None)"
            for place, argument in enumerate(names):
                state = [value if index == place else np.ones(2) for index in range(len(names))]
                # An array of the right shape is not looked at, which would cost too much; NumPy warns of complex ones.
                if fault in ("complex", "truth values"):
                    state = [list(each) for each in state]
                with pytest.raises(InputError, match=f"^{argument} {message}"):
                    getattr(system, name)(*state)


def of_function(sizes):
    return describe("differential-network", sizes=sizes, activation="tanh", members=1, precision="f64")


def test_a_network_of_x_refuses_and_converts_likewise(tmp_path):
    draw = np.random.default_rng(0).normal
    layers = tuple((jnp.asarray(draw(size=(1, *size))), jnp.zeros((1, size[1]))) for size in ((2, 3), (3, 1)))
    save(tmp_path, of_function([2, 3, 1]), layers)
    derivatives = load(tmp_path).derivatives
    jax.tree.map(np.testing.assert_array_equal, derivatives([1, 0]), derivatives(np.array([1.0, 0.0])))
    for value, message in (MALFORMED[fault] for fault in MALFORMED if fault != "text"):
        with pytest.raises(InputError, match=f"^x {message}"):
            derivatives(value)


DOUBLE = """
import sys
import jax
from pathlib import Path
from dln_jax import InputError, load
from dln_jax.deploy.c.run import export_run
from dln_jax.deploy.stablehlo import load_stablehlo
folder = Path(sys.argv[1])
loads = {
    "run": lambda: load(folder / "run").dynamics,
    "field": lambda: load(folder / "field").flow,
    "function": lambda: load(folder / "function"),
    "c": lambda: export_run(folder / "run", folder / "c", functions=["gravity"]),
    "export": lambda: load_stablehlo(folder / "sine.stablehlo"),
}
messages = {}
for name, make in loads.items():
    try:
        make()
    except InputError as error:
        messages[name] = str(error)
(line,) = {message.split("`")[1] for message in messages.values()}
print(len(messages), *messages.values(), sep=chr(10))
exec(line)
results = {name: make() for name, make in loads.items()}
print(results["run"].inverse_dynamics([0, 1], [1, 0], [0, 0]).dtype, results["export"]([1, 2]).dtype)
"""


def test_double_precision_is_asked_for_in_one_line_that_works(tmp_path):
    """In a process of its own, in which JAX computes in 32 bits: each refusal names the line, after which all load."""
    pytest.importorskip("flatbuffers", reason="jax.export writes artefacts with flatbuffers")
    for folder in ("run", "field", "function"):
        (tmp_path / folder).mkdir()
    loaded("structured-delan")(tmp_path / "run")
    loaded_field(tmp_path / "field")
    save(tmp_path / "function", of_function([2, 1]), ((jnp.ones((1, 2, 1)), jnp.zeros((1, 1))),))
    export_stablehlo(jnp.sin, np.zeros(2), path=tmp_path / "sine.stablehlo")
    result = subprocess.run([sys.executable, "-c", DOUBLE, tmp_path], capture_output=True, text=True, timeout=200)
    assert result.returncode == 0, result.stderr
    count, *messages, types = result.stdout.splitlines()
    assert count == "5" and len(messages) == 5 and types == "float64 float64"
    assert messages[0].startswith(f"{tmp_path / 'run'} needs double precision")
