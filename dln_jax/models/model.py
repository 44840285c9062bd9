"""What every model of the zoo is: parameters, and the energies that they give.

The keywords that factories share: `width` hidden units in each of `depth` hidden layers, of every network of the model;
their `activation`, which must be smooth where forces are derivatives of an energy; `dtype` of the parameters. `needs`
is what the scene needs, and decides features and terms. A width, depth or scale that is not positive is refused, and
scales that are not one number or one for each coordinate (InputError).
"""

import inspect
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import haiku as hk
import jax.numpy as jnp
import numpy as np
from jax import Array

from dln_jax.mechanics.arguments import OfSize

Parameters = Any
"""A pytree of arrays."""


class Model(NamedTuple):
    """Energies with parameters, as a pair of pure functions.

    `energies` closes the parameters over, so that a trained model and a textbook system are the same type and run
    through the same mechanics: `mechanics.equations.dynamics(model.energies(parameters))`.
    """

    init: Callable[[Array], Parameters]
    """Random key -> parameters."""
    energies: Callable[[Parameters], Any]
    """Parameters -> a record of energies, one of `mechanics.equations.System`, as functions of one state."""


def model_of(
    record: Callable[..., Any], terms: Callable[[], Mapping[str, Callable[..., Any] | None]], d: int, dtype: Any
) -> Model:
    """The model whose energies are `record(**terms)`.

    Args:
        record: of functions of one state; what the scene lacks is not handed to it.
        terms: builds Haiku modules, and gives by name the functions that use them; `None` for what is absent.
        d: degrees of freedom. Where the parameters are made every argument is (0, 1, ..), where no two bodies meet.
        dtype: of the parameters.
    """

    def build():
        functions = {name: term for name, term in terms().items() if term is not None}

        def initialise(q: Array) -> None:
            for each in functions.values():
                each(*[q] * len(inspect.signature(each).parameters))

        return initialise, functions

    networks = hk.without_apply_rng(hk.multi_transform(build))
    return Model(
        init=lambda key: networks.init(key, jnp.asarray(np.arange(d), dtype)),
        energies=lambda parameters: record(
            **{name: OfSize(partial(each, parameters), d) for name, each in networks.apply.items()}
        ),
    )
