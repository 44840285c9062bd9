"""Policies of untrained value networks of a chosen size, for timing and export."""

from collections.abc import Sequence

import jax

from dln_jax.control.optimal.plants import PLANTS
from dln_jax.control.optimal.problem import hjb_policy
from dln_jax.control.optimal.value_networks import value_network
from dln_jax.control.state_space import Law


def drawn_law(plant: str = "cart-pole", *, widths: Sequence[int] = (64, 64), members: int = 1, seed: int = 0) -> Law:
    """The policy x [n] -> u [m] of a random, untrained network; a call takes the same time as with a trained one."""
    problem = PLANTS[plant]().problem
    network = value_network(problem, widths=widths, members=members, scale=30.0)
    parameters = network.init(jax.random.key(seed))
    return hjb_policy(lambda x: network.value_and_gradient(parameters, x), problem)
