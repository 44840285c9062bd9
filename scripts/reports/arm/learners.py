"""The models compared in the first DeLaN paper, each with a fit that is compiled once.

Lutter, Ritter and Peters (2019, arXiv:1907.04490). Sizes and scales are fixed in advance of the data.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from dln_jax.learning.online import Refit, make_linear_refit, make_refit
from dln_jax.mechanics.equations import dynamics
from dln_jax.models.baselines import make_feed_forward
from dln_jax.models.lagrangian import make_black_box_lagrangian, make_delan
from dln_jax.models.model import Model, Parameters
from dln_jax.models.planar_chain import make_planar_chain
from dln_jax.scenes.pendulums import two_link_arm
from scripts.reports.arm.models import WIDTHS

RATE, ACCELERATION, TORQUE = 0.5, 2.0, 2.0
"""Typical magnitudes of a letter's motion in rad/s, rad/s² and N m; they scale the networks for all data."""
IDENTIFIED = "identified-arm"


class Learner(NamedTuple):
    """A model and its fit."""

    model: Model
    refit: Refit
    start: Callable[[int], Parameters]
    """Seed -> initial parameters."""
    torques: Callable[[Parameters, Any, Any, Any], Array]
    """(parameters, q, qd, qdd [N, d]) -> tau [N, d]."""


@functools.cache
def learners(*, rounds: int) -> dict[str, Learner]:
    """The models by name; networks are fitted by `rounds` of five Levenberg-Marquardt iterations.

    The identified arm is a planar chain of two links with unknown inertias, weights and joint friction: 12 parameters
    by linear least squares.
    """
    needs = two_link_arm().needs
    size = {name: {"width": width, "dtype": jnp.float64} for name, width in WIDTHS.items()}
    both_sides = make_feed_forward(
        needs, rate_scale=RATE, acceleration_scale=ACCELERATION, tau_scale=TORQUE, **size["feed-forward"]
    )

    def inverse_side(key: Array) -> Parameters:
        return {name: layers for name, layers in both_sides.init(key).items() if name.startswith("inverse")}

    networks = {
        "structured-delan": make_delan(needs, **size["structured-delan"]),
        "black-box-delan": make_black_box_lagrangian(needs, rate_scale=RATE, **size["black-box-delan"]),
        "feed-forward": Model(inverse_side, both_sides.energies),
    }
    chain = make_planar_chain(needs._replace(friction=True), symmetric=False)
    return {
        **{name: _learner(model, make_refit(model, rounds=rounds)) for name, model in networks.items()},
        IDENTIFIED: _learner(chain, make_linear_refit(chain)),
    }


def _learner(model: Model, refit: Refit) -> Learner:
    @jax.jit
    def torques(parameters: Parameters, *motion: Array) -> Array:
        return jax.vmap(dynamics(model.energies(parameters)).inverse_dynamics)(*motion)

    return Learner(model, refit, jax.jit(lambda seed: model.init(jax.random.key(seed))), torques)
