"""Controllers as C: the time of one call from warm and cold caches, in microseconds."""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from dln_jax.control import Gains, Reference, computed_torque, feed_forward
from dln_jax.control.optimal.plants import PLANTS
from dln_jax.control.optimal.problem import hjb_policy
from dln_jax.control.optimal.value_networks import value_network
from dln_jax.export.c.source import export_c
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.trees import tree_system
from scripts.reports.control.desktop import laws, pole
from scripts.reports.robots.arm import DAMPING, STIFFNESS, D, arm
from scripts.reports.run import Numbers
from scripts.reports.speed.exported_c import compiled, evicting, programs, random_network, timed


def tracking(law: Callable[..., Any]) -> tuple[Callable[..., Any], tuple[Any, ...]]:
    """A law of seven joints as a function of arrays, with examples."""
    return lambda q, qd, wanted, rates, accelerations: law(q, qd, Reference(wanted, rates, accelerations)), (
        np.zeros(D),
    ) * 5


def laws_in_c(*, repeats: int = 9, calls: int = 1000, cold: int = 1000) -> Numbers:
    """Medians of warm calls, and quantiles of cold ones; at least 32 MiB are read before each of those."""
    near, swing_up = laws(pole("rotary-pendulum"))
    tree, stiff = dynamics(tree_system(arm(coulomb=False).tree)), Gains(np.full(D, 400.0), np.full(D, 40.0))
    problem = PLANTS["cart-pole"]().problem
    network = value_network(problem, widths=(64, 64), scale=30.0)
    parameters = network.init(jax.random.key(0))
    functions = {
        "regulator": (near, (np.zeros(4),)),
        "swing_up": (swing_up, (np.array([0.0, np.pi, 0.0, 0.0]),)),
        "tree_feed_forward": tracking(feed_forward(tree, Gains(STIFFNESS, DAMPING))),
        "tree_computed_torque": tracking(computed_torque(tree, stiff)),
        "network_computed_torque": tracking(computed_torque(dynamics(random_network(D, 32, "f64")), stiff)),
        "value_policy": (hjb_policy(lambda x: network.value_and_gradient(parameters, x), problem), (np.zeros(4),)),
    }
    measured = {}
    for name, function in functions.items():
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place) / name
            export_c({name: function}, folder, stack=2**21)
            program = programs(folder, compiled(folder, folder), [name])[name]
            times = timed(program, repeats=repeats, calls=calls, cold=cold, mebibytes=max(evicting(), 32))
        p50, p999 = np.percentile(times.cold, [50, 99.9]) / 1e3
        measured[f"laws/{name}"] = {"warm_us": np.median(times.hot) / 1e3, "cold_p50_us": p50, "cold_p999_us": p999}
    return measured
