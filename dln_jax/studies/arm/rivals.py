"""The models that the first DeLaN paper compares, in sizes and units that are stated before any data are seen."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.data.schema import Trajectories
from dln_jax.learning.online import Refit, Replay, make_linear_refit, make_refit
from dln_jax.models.baselines import make_feed_forward
from dln_jax.models.lagrangian import make_black_box_lagrangian, make_delan
from dln_jax.models.model import Model, Parameters
from dln_jax.models.planar_chain import make_planar_chain
from dln_jax.scenes.two_link_arm import two_link_arm
from dln_jax.studies.arm.models import WIDTHS

RATE, ACCELERATION, TORQUE = 0.5, 2.0, 2.0
"""Typical sizes of a letter's motion: rad/s, rad/s² and N m. Every network is scaled by them, whatever it is fitted to."""
IDENTIFIED = "identified-arm"


class Rival(NamedTuple):
    """A model and how it is fitted."""

    model: Model
    refit: Refit


def rivals(*, rounds: int) -> dict[str, Rival]:
    """The models by name; networks are fitted by `rounds` of five iterations of Levenberg-Marquardt.

    The identified arm is a planar chain of two links, of which inertias, weights and the friction of both joints are
    unknown: 12 parameters by linear least squares.
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
        **{name: Rival(model, make_refit(model, rounds=rounds)) for name, model in networks.items()},
        IDENTIFIED: Rival(chain, make_linear_refit(chain)),
    }


def _inverse_side(parameters: Parameters) -> Parameters:
    """Without the network of the forward dynamics, which nothing here fits or uses."""
    return {name: each for name, each in parameters.items() if name.startswith("inverse")}


def size(rival: Rival) -> int:
    """How many parameters are fitted."""
    return sum(leaf.size for leaf in jax.tree.leaves(jax.eval_shape(rival.model.init, jax.random.key(0))))


def replay_of(data: Trajectories, fitted: np.ndarray, held_out: np.ndarray) -> Replay:
    """All samples of a file, of which masks [N] say which are fitted and which are held out."""
    return Replay(data.q, data.qd, data.qdd, data.tau, fitted.astype(float), held_out.astype(float))
