"""The unscented filter gives in C what it gives in JAX, sample by sample along a motion."""

import jax
import numpy as np

import dln_jax
from dln_jax.control.estimate import belief, mechanical, unscented
from dln_jax.export.c.interface import stated_costs
from dln_jax.export.c.load import load_c
from dln_jax.export.c.source import export_c
from dln_jax.scenes import cart_pole

SCENE = cart_pole()
PROCESS = mechanical(
    dln_jax.dynamics(SCENE.closed_form), np.array(SCENE.needs.actuation),
    rate=100.0, band=[0.2, 0.01], encoder_noise=[1e-3, 2e-3],
)  # fmt: skip
SAMPLES = 10


def test_a_filter_in_c_follows_the_one_in_jax(tmp_path):
    kalman = unscented(PROCESS)
    leaves, tree = jax.tree.flatten(kalman.start(belief([0.0, np.pi, 0.0, 0.0], [0.01, 0.05, 0.05, 0.1])))

    def sample(y, seen, u, *memory):
        memory, innovation = kalman.update(jax.tree.unflatten(tree, memory), y, seen)
        after = jax.tree.leaves(kalman.predict(memory, u))
        named = {f"after_{number}": leaf for number, leaf in enumerate(after)}
        return {"x": memory.x, "residual": innovation.residual, **named}

    examples = (np.zeros(2), np.ones(2, bool), np.zeros(1), *map(np.asarray, leaves))
    export_c({"sample": (sample, examples)}, tmp_path, finite=True, loop_bound=30)
    assert stated_costs(tmp_path)["sample"].unbounded_loops == 0
    in_jax, in_c = jax.jit(sample), load_c(tmp_path, flags=("-O1",)).sample
    random, memory, memory_in_c = np.random.default_rng(0), leaves, [np.asarray(leaf) for leaf in leaves]
    for number in range(SAMPLES):
        y = np.array([0.01, np.pi]) + 0.02 * number * np.array([1.0, -1.0]) + 1e-3 * random.normal(size=2)
        seen, u = np.array([True, number % 3 != 1]), np.array([np.sin(number)])
        expected, got = in_jax(y, seen, u, *memory), in_c(y, seen, u, *memory_in_c)
        np.testing.assert_allclose(got.x, expected["x"], rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(got.residual, expected["residual"], rtol=1e-8, atol=1e-12)
        memory = [np.asarray(expected[f"after_{k}"]) for k in range(len(leaves))]
        memory_in_c = [np.asarray(getattr(got, f"after_{k}")) for k in range(len(leaves))]
    assert np.abs(got.x[2:]).min() > 0.1  # it moves
