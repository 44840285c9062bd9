"""Networks: functions of x without physics."""

from dln_jax.nn import differential_mlp, ensembles, haiku_layers
from dln_jax.nn.activations import Activation, activation
from dln_jax.nn.differential_mlp import Layers, value, value_and_jacobian, value_jacobian_and_hessian

__all__ = [
    "Activation",
    "Layers",
    "activation",
    "differential_mlp",
    "ensembles",
    "haiku_layers",
    "value",
    "value_and_jacobian",
    "value_jacobian_and_hessian",
]
