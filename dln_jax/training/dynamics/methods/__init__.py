"""The ways of fitting a model to trajectories with torques, by the name of the model.

A new way of fitting is a file in this folder that defines a `Method`, and a line in `METHODS`.
"""

from dln_jax.training.dynamics.methods.kernel import KERNEL
from dln_jax.training.dynamics.methods.learned_tree import LEARNED_TREE
from dln_jax.training.dynamics.methods.least_squares import LEAST_SQUARES
from dln_jax.training.dynamics.methods.network import NETWORK
from dln_jax.training.dynamics.task import Method

METHODS: dict[str, Method] = {
    "structured-delan": NETWORK,
    "black-box-delan": NETWORK,
    "feed-forward": NETWORK,
    "structured-hnn": NETWORK,
    "black-box-hnn": NETWORK,
    "trigonometric": LEAST_SQUARES,
    "trigonometric-kernel": KERNEL,
    "learned-tree": LEARNED_TREE,
}
