"""The type of all models: parameters, and the energies that they define.

Factories share these keywords: `width` hidden units in all of the `depth` hidden layers of the model's networks; their
`activation`, which must be smooth if forces are derivatives of an energy; `dtype` of the parameters. `needs` describes
the scene and decides features and terms. Factories raise InputError for a width, depth or scale that is not positive,
and for scales that are neither one number nor one per coordinate.
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

    `energies` closes over the parameters, so that a trained model and a textbook system are the same type and run
    through the same mechanics: `mechanics.equations.dynamics(model.energies(parameters))`.
    """

    init: Callable[[Array], Parameters]
    """Random key -> parameters."""
    energies: Callable[[Parameters], Any]
    """Parameters -> a record of energies, one of `mechanics.equations.System`, as functions of one state."""


def model_of(
    record: Callable[..., Any], terms: Callable[[], Mapping[str, Callable[..., Any] | None]], d: int, dtype: Any
) -> Model:
    """Returns the model whose energies are `record(**terms)`.

    Args:
        record: takes functions of one state as keywords; absent terms are not passed.
        terms: builds Haiku modules and returns functions that use them, by name; `None` for absent terms.
        d: degrees of freedom. The parameters are initialised at the arguments (0, 1, ..), where no two bodies coincide.
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
