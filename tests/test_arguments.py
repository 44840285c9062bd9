"""One type, one call: what dynamics of every origin take, what they refuse in one line, and what M is at rest."""

import functools
import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.deploy.kinds import build
from dln_jax.deploy.load import load_phase_field, load_run, save_model
from dln_jax.deploy.phase_kinds import build_phase
from dln_jax.mechanics import hamiltonian, lagrangian, natural, natural_hamiltonian
from dln_jax.mechanics.natural import NaturalSystem
from dln_jax.mechanics.natural_hamiltonian import NaturalHamiltonian
from dln_jax.models.phase_field import from_dynamics, phase_field
from dln_jax.scenes import scene as textbook
from dln_jax.scenes.cart_pole import cart_pole
from dln_jax.types import InputError

SCENE = cart_pole(friction=0.1)
NETWORK = {"precision": "f64", "activation": "tanh", "width": 3, "depth": 1, "needs": SCENE.needs._asdict()}


def description(kind):
    keys = ("precision", "needs") if kind in ("trigonometric", "polynomial-hamiltonian") else NETWORK
    given = {"kind": kind, **{key: NETWORK[key] for key in keys}}
    return given | {"needs": SCENE.needs._replace(friction=False)._asdict()} if kind.startswith("poly") else given


@functools.cache
def parameters_of(make, kind):
    # Drawn here and not by `init`, which is slow to compile.
    draw = np.random.default_rng(0).normal
    return jax.tree.map(
        lambda leaf: jnp.asarray(draw(size=leaf.shape)), jax.eval_shape(make(description(kind)).init, KEY)
    )


KEY = jax.random.key(0)
FACTOR = np.array([[1.0, 0.0], [0.3, 2.0]])


def H(q, p):
    return jnp.sum(jnp.sqrt(1 + p**2)) + jnp.sum(q**2)


def network(kind):
    return lambda folder: build(description(kind)).apply(parameters_of(build, kind))


def loaded(kind):
    def load(folder):
        save_model(folder, description(kind), parameters_of(build, kind))
        return load_run(folder)

    return load


ORIGINS = {
    "scene": lambda folder: textbook.dynamics(SCENE),
    "lagrangian": lambda folder: lagrangian.dynamics(SCENE.lagrangian),
    "natural": lambda folder: natural.dynamics(NaturalSystem(lambda q: jnp.cos(q[0]) * FACTOR)),
    "hamiltonian": lambda folder: hamiltonian.dynamics(H),
    "natural hamiltonian": lambda folder: natural_hamiltonian.dynamics(NaturalHamiltonian(lambda q: FACTOR + 0 * q[0])),
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
    "hamiltonian": ("q", "p"),
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
        function = getattr(system, name)
        if function is not None and (system.has_energy or name not in ("energy", "mass_matrix")):
            yield name, function, names


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
    system = lagrangian.dynamics(lambda q, qd: jnp.sum(qd**2))
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
    if not system.has_energy or origin == "hamiltonian":  # it takes seconds to compile
        return
    q, qd = arrays["q"], arrays["qd"]

    @jax.jit
    def numbers():
        mass = system.mass_matrix
        return (system.energy(given["q"], given["qd"]), mass(q=q)), (system.energy(q, qd), mass(given["q"], 0 * qd))

    jax.tree.map(lambda one, other: np.testing.assert_allclose(one, other, rtol=1e-12), *numbers())


def test_what_a_model_without_energy_is_asked_for_is_refused(tmp_path):
    for origin in ("feed-forward", "loaded feed-forward"):
        system = ORIGINS[origin](tmp_path)
        assert not system.has_energy and system.hamiltonian is None
        for ask in (system.energy, system.mass_matrix):
            with pytest.raises(InputError, match="comes from no energy"):
                ask([0.1, 0.2], [0.3, 0.4])
    assert textbook.dynamics(SCENE).has_energy


def test_the_edge_leaves_no_trace_in_a_program():
    """Arrays that fit pass through: no operation is added to a compiled function, in either type."""
    for dtype in (np.float32, np.float64):
        state = [np.ones(2, dtype)] * 3
        plain = jax.make_jaxpr(functools.partial(lagrangian.forward_dynamics, SCENE.lagrangian))(*state)
        assert str(jax.make_jaxpr(lagrangian.dynamics(SCENE.lagrangian).forward_dynamics)(*state)) == str(plain)


FIELDS = {
    "energy": lambda folder: phase_field(H, dissipation=lambda q, qd: jnp.sum(qd**2)),
    "dynamics": lambda folder: from_dynamics(network("structured-hnn")(folder)),
    **{
        kind: lambda folder, kind=kind: build_phase(description(kind)).apply(parameters_of(build_phase, kind))
        for kind in ("separable-hamiltonian", "polynomial-hamiltonian", "phase-network")
    },
}


def loaded_field(folder):
    kind = "separable-hamiltonian"
    save_model(folder, description(kind), parameters_of(build_phase, kind))
    return load_phase_field(folder)


@pytest.mark.parametrize("origin", [*FIELDS, "loaded"])
def test_a_phase_field_refuses_and_converts_likewise(origin, tmp_path):
    field = {**FIELDS, "loaded": loaded_field}[origin](tmp_path)
    fine = np.array([0.3, 0.1])
    for function, names in ((field.rates, ("q", "p")), (field.energy, ("q", "p")), (field.dissipation, ("q", "qd"))):
        if function is None:
            continue
        for value, message in (MALFORMED[fault] for fault in ("batch", "number", "too few", "too many", "complex")):
            with pytest.raises(InputError, match=f"^{names[1]} {message}"):
                function(fine, value)
            if np.ndim(value) != 1:
                with pytest.raises(InputError, match=f"^q {message}"):
                    function(value, fine)
        got, expected = jax.jit(lambda f=function: (f((1, 0), [0.5, 1]), f(np.array([1.0, 0]), np.array([0.5, 1]))))()
        jax.tree.map(np.testing.assert_array_equal, got, expected)
