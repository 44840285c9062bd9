"""Fields of a phase space by their Helmholtz decomposition: what each part cannot be."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from calls import one_line

from dln_jax.mechanics.dynamics import Flow, PhaseRates
from dln_jax.mechanics.equations import flow
from dln_jax.models.baselines import make_helmholtz
from dln_jax.types import Needs

PLANE = Needs(joints=("prismatic", "revolute"))


def random_field(field):
    model = make_helmholtz(PLANE, field=field, width=5, depth=1, dtype=jnp.float64)
    return flow(model.energies(model.init(jax.random.key(1))))


def jacobian(rates, x):
    return jax.jacfwd(lambda x: jnp.concatenate(rates(x[:2], x[2:])))(x)


@pytest.mark.slow
def test_each_part_lacks_what_it_must():
    x = jnp.array([0.3, -0.8, 0.5, 1.1])
    solenoidal, conservative, both = (random_field(each) for each in ("solenoidal", "conservative", "both"))
    assert isinstance(solenoidal, Flow) and isinstance(both, Flow) and isinstance(conservative, PhaseRates)
    J, C, B = (jacobian(each.rates, x) for each in (solenoidal, conservative, both))
    assert abs(jnp.trace(J)) < 1e-14 and jnp.abs(J - J.T).max() > 1e-3
    np.testing.assert_allclose(C, C.T, atol=1e-14)
    assert abs(jnp.trace(C)) > 1e-3 and abs(jnp.trace(B)) > 1e-3 and jnp.abs(B - B.T).max() > 1e-3
    # The energy of the solenoidal part is constant along its own flow.
    q, p = x[:2], x[2:]
    _, change = jax.jvp(solenoidal.energy, (q, p), solenoidal.rates(q, p))
    assert abs(change) < 1e-14


def test_an_unknown_field_is_refused():
    with one_line("field is 'rotational'; expected one of solenoidal, conservative, both"):
        make_helmholtz(PLANE, field="rotational")  # pyright: ignore[reportArgumentType]
