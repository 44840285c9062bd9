"""The models compared in the first DeLaN paper, with sizes and scales fixed in advance of the data."""

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


class Rival(NamedTuple):
    """A model and its fit; the functions are compiled once for all cases of a report."""

    model: Model
    refit: Refit
    start: Callable[[int], Parameters]
    """Seed -> initial parameters."""
    torques: Callable[[Parameters, Any, Any, Any], Array]
    """(parameters, q, qd, qdd [N, d]) -> tau [N, d]."""


@functools.cache
def rivals(*, rounds: int) -> dict[str, Rival]:
    """The models by name; networks are fitted by `rounds` of five Levenberg-Marquardt iterations.

    The identified arm is a planar chain of two links with unknown inertias, weights and joint friction: 12 parameters
    by linear least squares.
    """
    needs = two_link_arm().needs
    width = {name: {"width": WIDTHS[name], "dtype": jnp.float64} for name in WIDTHS}
    both_sides = make_feed_forward(
        needs, rate_scale=RATE, acceleration_scale=ACCELERATION, tau_scale=TORQUE, **width["feed-forward"]
    )
    networks = {
        "structured-delan": make_delan(needs, **width["structured-delan"]),
        "black-box-delan": make_black_box_lagrangian(needs, rate_scale=RATE, **width["black-box-delan"]),
        "feed-forward": Model(lambda key: _inverse_side(both_sides.init(key)), both_sides.energies),
    }
    chain = make_planar_chain(needs._replace(friction=True), symmetric=False)
    return {
        **{name: _rival(model, make_refit(model, rounds=rounds)) for name, model in networks.items()},
        IDENTIFIED: _rival(chain, make_linear_refit(chain)),
    }


def _rival(model: Model, refit: Refit) -> Rival:
    @jax.jit
    def torques(parameters: Parameters, *motion: Array) -> Array:
        return jax.vmap(dynamics(model.energies(parameters)).inverse_dynamics)(*motion)

    return Rival(model, refit, jax.jit(lambda seed: model.init(jax.random.key(seed))), torques)


def _inverse_side(parameters: Parameters) -> Parameters:
    """Drops the network of the forward dynamics, which is not used here."""
    return {name: layers for name, layers in parameters.items() if name.startswith("inverse")}


def size(rival: Rival) -> int:
    """Number of fitted parameters."""
    return sum(leaf.size for leaf in jax.tree.leaves(jax.eval_shape(rival.model.init, jax.random.key(0))))
