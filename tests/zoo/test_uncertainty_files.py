"""Uncertainties come back with their run, in C too, or are refused in one line."""

import json
import shutil

import jax
import numpy as np
import pytest
from calls import one_line
from compilers import needs_compiler
from numpy.testing import assert_allclose

from dln_jax import Needs, build, describe, load_c
from dln_jax.export.c.source import export_c
from dln_jax.export.functions import functions_of_run
from dln_jax.models.uncertainty import Domain, Uncertainty, out_of_distribution, predictive
from dln_jax.zoo.parameter_files import save_uncertainty
from dln_jax.zoo.run import load, save

NEEDS = Needs(joints=("revolute", "prismatic"), friction=True)
DESCRIPTION = describe("structured-delan", needs=NEEDS, precision="f64", width=3, depth=1)
MODEL = build(DESCRIPTION)
PARAMETERS = MODEL.init(jax.random.key(0))
P = sum(leaf.size for leaf in jax.tree.leaves(PARAMETERS))
STATES = np.random.default_rng(2).uniform(-1, 1, (20, 3, 2))


def known(undetermined=0):
    random = np.random.default_rng(0)
    directions = np.linalg.qr(random.normal(size=(P, P)))[0]
    # About half of the states within 1 of zero are within 0.9 in all coordinates. No deviation exceeds its limit.
    ranges, harmless = (np.zeros(6), np.full(6, 0.9)), np.zeros(2)
    domain = Domain(np.array([30.0, 50.0]), np.ones(P), directions[:, :undetermined], *ranges, harmless)
    return Uncertainty(0.05 * random.normal(size=(P, P)), np.array([0.1, 0.2]), np.array([1.0, 4.0]), domain)


@pytest.fixture
def folder(tmp_path):
    save(tmp_path, DESCRIPTION, PARAMETERS)
    return tmp_path


def test_it_comes_back_with_the_run(folder):
    stored = known(3)
    run = load_with(folder, stored)
    std = jax.jit(predictive(MODEL, PARAMETERS, *stored[:3]))
    flag = jax.jit(out_of_distribution(MODEL, PARAMETERS, stored))
    for state in STATES[:3]:
        np.testing.assert_allclose(run.torque_std(*state), std(*state), rtol=1e-12)
        assert run.out_of_distribution(*state.tolist()) == flag(*state)
    # Other parameters do not inherit it.
    save(folder, DESCRIPTION, PARAMETERS)
    run = load(folder)
    for name in ("torque_std", "out_of_distribution"):
        with one_line("the run has no uncertainty"):
            getattr(run, name)
    with one_line("has no torque_std"):
        functions_of_run(run, precision="f64", names=["torque_std"])


def test_what_is_damaged_or_does_not_fit_is_refused(folder, tmp_path_factory):
    with one_line("estimate it for that model"):
        save_uncertainty(folder, known()._replace(factor=np.zeros((P + 1, 2))))
    save_uncertainty(folder, known())
    other = tmp_path_factory.mktemp("other")
    save(other, DESCRIPTION, jax.tree.map(lambda leaf: leaf + 1, PARAMETERS))
    path, tensors = (folder / f"uncertainty.{ending}" for ending in ("json", "safetensors"))
    for file in (path, tensors):
        shutil.copy(file, other)
    with one_line("belongs to other parameters"):
        load(other)
    whole = path.read_text()
    path.write_text(json.dumps({**json.loads(whole), "tensors": {}}))
    with one_line("does not state its arrays"):
        load(folder)
    path.write_text(whole)
    tensors.write_bytes(tensors.read_bytes()[:-5])
    with one_line("truncated or altered"):
        load(folder)


@needs_compiler
def test_c_is_equal(folder, tmp_path):
    for precision, dtype, tolerance, undetermined in (("f64", float, 1e-11, 0), ("f32", np.float32, 1e-4, 3)):
        run, out = load_with(folder, known(undetermined)), tmp_path / precision
        export_c(functions_of_run(run, names=["torque_std", "out_of_distribution"], precision=precision), out)
        in_c, flags = load_c(out), set()
        for state in STATES:
            rounded = state.astype(dtype)
            assert_allclose(in_c.torque_std(*rounded), run.torque_std(*state), rtol=tolerance)
            flags.add(bool(run.out_of_distribution(*state)))
            assert bool(in_c.out_of_distribution(*rounded)) == bool(run.out_of_distribution(*state))
        assert flags == ({True} if undetermined else {True, False})


def test_a_state_out_of_range_is_outside_only_where_the_deviation_matters(folder):
    stored = known()
    run = load_with(folder, stored)
    variances = np.array([run.torque_std(*state) ** 2 for state in STATES]) - stored.noise**2
    deviations = np.sqrt(np.maximum(variances, 0) / stored.inflation)
    level = np.median(deviations, axis=0)
    run = load_with(folder, stored._replace(domain=stored.domain._replace(harmless=level)))
    away = np.abs(STATES).max(axis=(1, 2)) > 0.9
    expected = away & (deviations >= level).any(axis=1)
    assert [bool(run.out_of_distribution(*state.tolist())) for state in STATES] == expected.tolist()
    assert 0 < expected.sum() < away.sum()


def load_with(folder, uncertainty):
    save_uncertainty(folder, uncertainty)
    return load(folder)
