"""Derivatives of an impact with friction, by the materials and the contact, beside central differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dln_jax.softbody.scene import with_parameters
from dln_jax.softbody.step import make_step


def compare_derivatives_with_differences(scene, v, *, steps, tolerance):
    """Requires agreement to 1e-6 after some steps of 10 ms; E and kappa are 1e5 Pa, and the friction is 0.3."""
    init, step = make_step(scene, 0.01, tolerance=tolerance)

    def outcome(values):
        params = with_parameters(
            scene.params, elastic={"youngs_modulus": values[0]}, contact={"stiffness": values[1], "friction": values[2]}
        )
        state, info = jax.lax.scan(lambda state, _: step(params, state), init(v=v), None, length=steps)
        return jnp.sum(state.x[:, 0] ** 2) + jnp.sum(state.v[:, 1]), info.converged

    require_gradient_of_differences(outcome, np.array([1e5, 1e5, 0.3]), np.array([10.0, 10.0, 1e-5]))


def require_gradient_of_differences(outcome, at, changes):
    """Requires agreement to 1e-6 of the gradient of `outcome(at [k])`, a number and whether its steps converged."""
    program = jax.jit(jax.value_and_grad(outcome, has_aux=True))
    (_, converged), gradient = program(jnp.asarray(at))
    assert np.all(converged)
    for place, moved in enumerate(np.diag(changes)):
        difference = (program(at + moved)[0][0] - program(at - moved)[0][0]) / (2 * changes[place])
        assert float(gradient[place]) == pytest.approx(float(difference), rel=1e-6), place
