"""The structured model does no work for terms that a scene lacks, and keeps its precision."""

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.mechanics.equations import dynamics
from dln_jax.models.model import make_delan
from dln_jax.types import Needs


def small(friction=False, gravity=True):
    needs = Needs(("revolute", "revolute"), gravity=gravity, friction=friction)
    return make_delan(needs, width=6, depth=2, dtype=jnp.float64)


def flops_and_parameters(model, name, d):
    """Floating-point operations of a function (q, qd, x) of the dynamics, and how many parameters the model has."""
    parameters = jax.eval_shape(model.init, jax.random.key(0))
    states = (jax.ShapeDtypeStruct((d,), jnp.float64),) * 3
    function = jax.jit(lambda p, *s: getattr(dynamics(model.energies(p)), name)(*s))
    flops = function.lower(parameters, *states).compile().cost_analysis()["flops"]
    return flops, sum(leaf.size for leaf in jax.tree.leaves(parameters))


def test_absent_terms_cost_nothing():
    def costs(**terms):
        return flops_and_parameters(small(**terms), "inverse_dynamics", 2)

    full, full_parameters = costs(friction=True)
    frictionless, frictionless_parameters = costs()
    weightless, weightless_parameters = costs(gravity=False)
    assert weightless < 0.75 * frictionless < 0.75 * full
    potential = 4 * 6 + 6 + 6 * 6 + 6 + 6 + 1
    assert full_parameters - frictionless_parameters == 2
    assert frictionless_parameters - weightless_parameters == potential


def test_single_precision_and_nan():
    """float32 loses no more than its rounding, and NaN in a state never becomes a finite answer."""
    model = small()
    parameters = jax.jit(model.init)(jax.random.key(1))
    narrow = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), parameters)
    q, qd, x = np.array([[0.4, 1.0], [1.0, -1.0], [0.5, 2.0]], np.float32)

    @jax.jit
    def answers(parameters, *state):
        system = dynamics(model.energies(parameters))
        return jnp.stack([system.inverse_dynamics(*state), system.forward_dynamics(*state)])

    single = answers(narrow, q, qd, x)
    assert single.dtype == jnp.float32
    exact = answers(parameters, *(array.astype(np.float64) for array in (q, qd, x)))
    np.testing.assert_allclose(single, exact, rtol=1e-4, atol=1e-5)
    for place in range(3):
        state = np.stack([q, qd, x])
        state[place, 0] = np.nan
        assert not np.isfinite(answers(narrow, *state)).all(axis=1).any()
