"""Every name gives the same model again from its folder, whatever becomes of defaults; one's own models too."""

import functools
import inspect
import json
import re
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line
from numpy.testing import assert_allclose, assert_array_equal

import dln_jax
from dln_jax import Model, NaturalSystem, Needs, PhaseRates
from dln_jax.data.schema import from_arrays
from dln_jax.mechanics.equations import Canonical, Energies
from dln_jax.mechanics.trees.description import serial, tree_to_json
from dln_jax.mechanics.trees.inertia import inertial_parameters
from dln_jax.zoo.catalogue import CATALOGUE
from dln_jax.zoo.descriptions import build, catalogued, describe, describe_for, typical_sizes
from dln_jax.zoo.run import load, save

SWING = Needs(joints=("revolute",), friction=True)
FREE = Needs(joints=("revolute",))
SMALL = {"width": 3, "depth": 1}
PENDULUM = serial(
    [np.eye(3)], [[0, 0, 0]], [inertial_parameters(1.0, [0.3, 0, 0], 0.1 * np.eye(3))], gravity=(0, -9.81, 0)
)
NETWORK = {"needs": SWING, **SMALL}
MODELS = {
    "structured-delan": {**NETWORK, "shared_trunk": True},
    "black-box-delan": {**NETWORK, "rate_scale": [2.0]},
    "trigonometric": {"needs": SWING, "degree": [2]},
    "trigonometric-kernel": {"needs": SWING, "samples": 4},
    "trigonometric-residual": {"needs": SWING, "degree": [2], "terms": ["inertia"], **SMALL},
    "trigonometric-kernel-residual": {"needs": SWING, "samples": 4, "terms": ["dissipation"], **SMALL},
    "rigid-tree": {"needs": SWING, "tree": tree_to_json(PENDULUM)},
    "rigid-tree-residual": {"needs": SWING, "tree": tree_to_json(PENDULUM), "terms": ["dissipation"], **SMALL},
    "planar-chain": {"needs": SWING},
    "learned-tree": {"needs": SWING},
    "feed-forward": {**NETWORK, "needs": FREE},
    "structured-hnn": NETWORK,
    "black-box-hnn": NETWORK,
    "separable-hnn": NETWORK,
    "pairwise-hnn": {"needs": Needs(joints=("prismatic",) * 4), **SMALL},
    "polynomial-hamiltonian": {"needs": FREE, "degree": 3},
    "phase-network": {**NETWORK, "needs": FREE},
    "helmholtz-hnn": {**NETWORK, "needs": FREE},
    "differential-network": {"sizes": [2, 3, 1], "activation": "cos", "members": 2},
    "latent-phase": {"field": "black-box-hnn", "pixels": 6, "components": 2, "width": 3, "field_width": 3},
}


def random_parameters(model):
    # Drawn here and not by `init`, which is slow to compile.
    draw = np.random.default_rng(0).normal
    return jax.tree.map(
        lambda leaf: jnp.asarray(0.3 * draw(size=leaf.shape), leaf.dtype), jax.eval_shape(model.init, jax.random.key(0))
    )


def stored(folder, name, precision="f64", **changes):
    description = describe(name, precision=precision, **{**MODELS[name], **changes})
    save(folder, description, random_parameters(build(description)))
    return description


def altered(folder, change):
    path = folder / "model.json"
    manifest = json.loads(path.read_text())
    change(manifest["model"])
    path.write_text(json.dumps(manifest))


def answer(name, run):
    """One number of a run, by what it gives."""
    if name == "differential-network":
        return run.derivatives([0.1, 0.2]).hessian.sum()
    if name == "latent-phase":
        return sum(run.images.encode(np.linspace(0, 1, 12)))[0]
    properties, q = CATALOGUE[name].properties, [0.3, 0.1, -0.4, 0.9][: len(MODELS[name]["needs"].joints)]
    # The catalogue describes a model by its energies.
    assert isinstance(run.energies, Energies) == properties.energy
    assert isinstance(run.energies, Canonical | PhaseRates) == properties.canonical
    if properties.definite:
        assert np.linalg.eigvalsh(run.dynamics.mass_matrix(q)).min() > 0
    return (run.flow.rates(q, q)[1] if properties.canonical else run.dynamics.inverse_dynamics(q, q, q))[0]


@pytest.mark.parametrize("name", CATALOGUE)
def test_a_stored_model_is_the_same_after_every_default_has_changed(name, tmp_path, monkeypatch):
    """Every keyword of the factory is in the file: what is built from it asks no default."""
    description = stored(tmp_path, name)
    run = load(tmp_path)
    assert run.description == description == json.loads(json.dumps(description))
    before = answer(name, run)
    assert np.isfinite(before) and before != 0
    entry, received = CATALOGUE[name], {}

    def remembers(function):
        @functools.wraps(function)
        def call(*arguments, **keywords):
            received.update(keywords)
            return function(*arguments, **keywords)

        return call

    additions = tuple(map(remembers, entry.additions))
    monkeypatch.setitem(CATALOGUE, name, entry._replace(factory=remembers(entry.factory), additions=additions))
    catalogued.cache_clear()  # the same description gives the same model
    again = load(tmp_path)
    assert {"name", "precision", *received} - {"dtype"} == set(description)
    jax.tree.map(assert_array_equal, run.parameters, again.parameters)


def test_missing_keywords_are_refused_and_never_filled_in():
    for name, settings in MODELS.items():
        description = describe(name, precision="f64", **settings)
        for key in {*description} - {"name", "precision"}:
            with one_line(f"model description: lacks {key}; restore"):
                build({other: value for other, value in description.items() if other != key})
    description = describe("feed-forward", precision="f64", **MODELS["feed-forward"])
    needs = {key: value for key, value in description["needs"].items() if key != "friction"}
    with one_line("needs lack friction"):
        build({**description, "needs": needs})


def test_what_a_model_cannot_give_is_refused_with_what_it_can(tmp_path):
    for name, asked, message in (
        ("phase-network", "dynamics", "a phase-network has no dynamics; use .flow"),
        ("feed-forward", "flow", "a feed-forward has no flow; use .dynamics"),
        ("structured-delan", "images", "a structured-delan has no images; use .dynamics or .flow"),
        ("differential-network", "energies", "a differential-network has no energies; use .derivatives"),
        ("latent-phase", "derivatives", "a latent-phase has no derivatives; use .images"),
    ):
        stored(tmp_path, name)
        with one_line(f"^{re.escape(message)}$"):
            getattr(load(tmp_path), asked)
    with one_line("leave factory= out"):
        load(tmp_path, factory=make_rod)


def test_functions_are_made_once_and_compute_in_the_precision_of_the_training(tmp_path):
    stored(tmp_path, "structured-hnn", precision="f32", friction_width=0)
    run = load(tmp_path)
    assert run.dynamics is run.dynamics and run.flow is run.flow
    tau = run.dynamics.inverse_dynamics([1], np.ones(1), np.ones(1))
    assert tau.dtype == run.flow.energy([1], [0.5]).dtype == jnp.float32
    # Parameters that were tuned are saved again.
    tuned = jax.tree.map(lambda leaf: 2 * leaf, run.parameters)
    with one_line("already contains a model"):
        dln_jax.save(tmp_path, run.description, tuned)
    dln_jax.save(tmp_path, run.description, tuned, overwrite=True)
    jax.tree.map(assert_array_equal, dln_jax.load(tmp_path).parameters, tuned)


# one's own models


def make_rod(needs: Needs, *, length: float = 2.0, dtype=jnp.float32) -> Model:
    """A rod with a learned mass."""

    def energies(mass):
        return NaturalSystem(
            cholesky=lambda q: jnp.sqrt(mass[:, None]) * length, potential=lambda q: -mass[0] * jnp.cos(q[0])
        )

    return Model(lambda key: jnp.ones(needs.degrees_of_freedom, dtype), energies)


@pytest.fixture
def module(tmp_path, monkeypatch):
    """A file of one's own that can be imported, and whether it was."""
    imports = "import jax.numpy as jnp\nfrom dln_jax import Model, NaturalSystem, Needs\n"
    (tmp_path / "rods.py").write_text(f"{imports}{inspect.getsource(make_rod)}\nnumber = 3\n")
    monkeypatch.syspath_prepend(tmp_path)
    yield lambda: "rods" in sys.modules
    sys.modules.pop("rods", None)


def test_a_model_of_ones_own_is_loaded_with_its_factory(tmp_path):
    description = describe(make_rod, needs=FREE, precision="f64")
    assert description["name"] == "own" and description["length"] == 2.0 and "rod" not in json.dumps(description)
    save(tmp_path, description, jnp.array([3.0]))
    with one_line("pass it as factory="):
        load(tmp_path, trust=True)
    run = load(tmp_path, factory=make_rod)
    assert_allclose(run.dynamics.mass_matrix([0.1]), [[12.0]])
    assert run.flow.energy([0.1], [0.0]) == -3 * jnp.cos(0.1)
    with one_line("lacks length"):
        altered(tmp_path, lambda model: model.pop("length"))
        load(tmp_path, factory=make_rod)


def test_a_factory_is_imported_by_name_only_when_it_is_trusted(tmp_path, module):
    save(tmp_path, describe("rods:make_rod", needs=FREE, precision="f64"), jnp.array([3.0]))
    sys.modules.pop("rods")
    with one_line("the factory rods:make_rod is not part of dln_jax; pass"):
        load(tmp_path)
    assert load(tmp_path, factory=make_rod) and not module()
    assert_allclose(load(tmp_path, trust=True).dynamics.mass_matrix([0.1]), [[12.0]])
    assert module()
    for name in ("rods:number", "rods:nothing", "no.such.module:make", ":", "rods:", "..rods:make_rod"):
        altered(tmp_path, lambda model, name=name: model.update(name=name))
        with one_line():
            load(tmp_path, trust=True)


def test_mistakes_in_a_description_are_named():
    for message, name, keywords in (
        ("model is 'delan'; this release knows structured-delan", "delan", {}),
        ("unknown keys 'colour'", "structured-delan", {"colour": 1}),
        ("which JSON cannot store", "black-box-hnn", {"initial_guess": jnp.sin}),
        ("tau_scale is inf", "feed-forward", {"tau_scale": np.inf}),
    ):
        with one_line(message):
            describe(name, precision="f64", **{"needs": FREE, **keywords})


def test_typical_sizes_are_those_of_the_data():
    qd, tau, p, pd = np.random.default_rng(0).normal(size=(4, 50, 2)) * [1.0, 4.0]
    times = {"t": np.arange(50.0), "trajectory": np.zeros(50, int)}
    data = from_arrays({**times, "q": qd, "qd": qd, "qdd": qd, "tau": tau, "p": p, "pd": pd})
    pooled = typical_sizes("phase-network", data, pooled=True)
    assert_allclose(typical_sizes("feed-forward", data)["tau_scale"], tau.std(axis=0), rtol=5e-3)
    assert_allclose(pooled["rate_scale"], np.std([qd, pd]), rtol=5e-3)
    assert_allclose(pooled["momentum_scale"], p.std(), rtol=5e-3)
    without, needs = data._replace(p=None, pd=None), Needs(joints=("prismatic",) * 2)
    with one_line("no momenta p"):
        typical_sizes("black-box-hnn", without, pooled=True)
    assert describe_for("black-box-hnn", without, needs, precision="f64")["momentum_scale"] == 1.0
