"""Costs of a model: a term that a scene lacks must not show here."""

import jax
import jax.numpy as jnp

from dln_jax.mechanics.equations import dynamics


def flops_and_parameters(model, name, d):
    """Floating-point operations of a function (q, qd, x) of the dynamics, and how many parameters the model has."""
    parameters = jax.eval_shape(model.init, jax.random.key(0))
    states = (jax.ShapeDtypeStruct((d,), jnp.float64),) * 3
    function = jax.jit(lambda p, *s: getattr(dynamics(model.energies(p)), name)(*s))
    flops = function.lower(parameters, *states).compile().cost_analysis()["flops"]
    return flops, sum(leaf.size for leaf in jax.tree.leaves(parameters))
