"""Uncertainties come back with their run, in C too, or are refused in one line."""

import json
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line

from dln_jax.export.c.families import functions_of_run
from dln_jax.export.c.load import load_c
from dln_jax.export.c.run import export_run
from dln_jax.models.uncertainty import Domain, Uncertainty, out_of_distribution, predictive
from dln_jax.types import InputError, Needs
from dln_jax.zoo.descriptions import build, describe
from dln_jax.zoo.run import load, save
from dln_jax.zoo.uncertainty_files import save_uncertainty

NEEDS = Needs(joints=("revolute", "prismatic"), friction=True)
DESCRIPTION = describe("structured-delan", needs=NEEDS, precision="f64", width=3, depth=1)
MODEL = build(DESCRIPTION)
PARAMETERS = MODEL.init(jax.random.key(0))
P = sum(leaf.size for leaf in jax.tree.leaves(PARAMETERS))
STATES = np.random.default_rng(2).uniform(-1, 1, (20, 3, 2))


def known(undetermined=0):
    random = np.random.default_rng(0)
    directions = np.linalg.qr(random.normal(size=(P, P)))[0]
    # Of states within 1 of zero about half are nearer than 0.9 in all coordinates; no deviation is above its limit.
    ranges, harmless = (np.zeros(6), np.full(6, 0.9)), np.zeros(2)
    domain = Domain(np.array([30.0, 50.0]), np.ones(P), directions[:, :undetermined], *ranges, harmless)
    return Uncertainty(0.05 * random.normal(size=(P, P)), np.array([0.1, 0.2]), np.array([1.0, 4.0]), domain)


@pytest.fixture
def folder(tmp_path):
    save(tmp_path, DESCRIPTION, PARAMETERS)
    return tmp_path


@pytest.mark.parametrize("undetermined", [0, 3])
def test_it_comes_back_with_the_run(folder, undetermined):
    stored = known(undetermined)
    save_uncertainty(folder, stored, ridge=1e-8)
    run = load(folder)
    std = jax.jit(predictive(MODEL, PARAMETERS, *stored[:3]))
    flag = jax.jit(out_of_distribution(MODEL, PARAMETERS, stored))
    for state in STATES[:3]:
        np.testing.assert_allclose(run.torque_std(*state), std(*state), rtol=1e-12)
        assert run.out_of_distribution(*state.tolist()) == flag(*state)


def test_a_run_without_it_says_so(folder):
    run = load(folder)
    for name in ("torque_std", "out_of_distribution"):
        with one_line("the run has no uncertainty"):
            getattr(run, name)
    with pytest.raises(InputError, match="has no torque_std"):
        functions_of_run(run, precision="f64", names=["torque_std"])


def test_other_parameters_do_not_inherit_it(folder, tmp_path_factory):
    save_uncertainty(folder, known())
    other = tmp_path_factory.mktemp("other")
    save(other, DESCRIPTION, jax.tree.map(lambda leaf: leaf + 1, PARAMETERS))
    for name in ("uncertainty.json", "uncertainty.safetensors"):
        shutil.copy(folder / name, other / name)
    with pytest.raises(InputError, match="belongs to other parameters"):
        load(other)
    save(folder, DESCRIPTION, PARAMETERS)
    assert load(folder).uncertainty is None


def test_what_is_damaged_or_does_not_fit_is_refused(folder):
    with pytest.raises(InputError, match="estimate it of that model"):
        save_uncertainty(folder, known()._replace(factor=np.zeros((P + 1, 2))))
    save_uncertainty(folder, known())
    path = folder / "uncertainty.json"
    whole = path.read_text()
    path.write_text(json.dumps({**json.loads(whole), "tensors": {}}))
    with pytest.raises(InputError, match="does not state its arrays"):
        load(folder)
    path.write_text(whole)
    tensors = folder / "uncertainty.safetensors"
    tensors.write_bytes(tensors.read_bytes()[:-5])
    with pytest.raises(InputError, match="truncated or altered"):
        load(folder)


@pytest.mark.slow
@pytest.mark.skipif(not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="there is no C compiler on the PATH")
@pytest.mark.parametrize(
    "precision, tolerance, undetermined, expected", [("f64", 1e-11, 0, {True, False}), ("f32", 1e-4, 3, {True})]
)
def test_c_is_equal(folder, tmp_path, precision, tolerance, undetermined, expected):
    save_uncertainty(folder, known(undetermined))
    export_run(folder, tmp_path / "c", functions=["torque_std", "out_of_distribution"], precision=precision)
    in_c, run = load_c(tmp_path / "c"), load(folder)
    flags = set()
    for state in STATES:
        arguments = state.astype(np.float64 if precision == "f64" else np.float32)
        np.testing.assert_allclose(in_c.torque_std(*arguments), run.torque_std(*state), rtol=tolerance)
        flags.add(bool(in_c.out_of_distribution(*arguments)))
        assert bool(in_c.out_of_distribution(*arguments)) == bool(run.out_of_distribution(*state))
    assert flags == expected


def test_it_is_stored_in_the_precision_of_the_model(tmp_path):
    description = {**DESCRIPTION, "precision": "f32"}
    save(tmp_path, description, build(description).init(jax.random.key(0)))
    save_uncertainty(tmp_path, known())
    assert load(tmp_path).torque_std(*STATES[0]).dtype == jnp.float32


def test_a_state_out_of_range_is_outside_only_where_the_deviation_matters(folder):
    stored = known()
    run = load_with(folder, stored)
    deviations = np.array([run.torque_std(*state) ** 2 - stored.noise**2 for state in STATES])
    deviations = np.sqrt(np.maximum(deviations, 0) / stored.inflation)
    level = np.median(deviations, axis=0)
    run = load_with(folder, stored._replace(domain=stored.domain._replace(harmless=level)))
    expected = [
        np.abs(state).max() > 0.9 and (each >= level).any() for state, each in zip(STATES, deviations, strict=True)
    ]
    assert [bool(run.out_of_distribution(*state.tolist())) for state in STATES] == expected
    assert {True, False} == set(expected) and sum(expected) < sum(np.abs(state).max() > 0.9 for state in STATES)


def load_with(folder, uncertainty):
    save_uncertainty(folder, uncertainty)
    return load(folder)
