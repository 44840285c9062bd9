"""Controllers as C: the time of one call from warm and cold caches.

Calls of a control loop are cold: other code has used the caches for a millisecond. To measure another controller, add a
line to `LAWS`.
"""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from dln_jax.control import Gains, Reference, computed_torque, feed_forward, first_plan
from dln_jax.control.optimal.plants import PLANTS
from dln_jax.control.optimal.problem import hjb_policy
from dln_jax.control.optimal.value_networks import value_network
from dln_jax.export.c.source import export_c
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.trees import tree_system
from dln_jax.scenes.pendulums import chain
from dln_jax.zoo.descriptions import build, describe
from scripts.reports.case import Findings
from scripts.reports.control.plans import in_jax
from scripts.reports.control.real_time import HANGING, STACK, STEPS, cart_pole, renewed
from scripts.reports.control.swing_ups import SWING_UPS, law_of, parts_of_law
from scripts.reports.robots.arm import DAMPING, STIFFNESS, D, arm
from scripts.reports.rows import Row
from scripts.reports.speed.calls_in_c import Times, compiled, evicting, programs, timed

LEAST_EVICTED = 32
"""Minimum memory, MiB, that is read before a cold call to evict the caches."""


class Law(NamedTuple):
    """A controller as a function of arrays."""

    function: Callable[..., Any]
    examples: tuple[Any, ...]
    """Example arguments."""


def regulator() -> Law:
    """A linear-quadratic regulator of four states and one motor, with wrapped angle errors."""
    return Law(parts_of_law(SWING_UPS["rotary-pendulum"]).regulator, (np.zeros(4),))


def swing_up() -> Law:
    """The energy law, with the regulator near the top."""
    return Law(law_of(SWING_UPS["rotary-pendulum"]), (np.array([0.0, np.pi, 0.0, 0.0]),))


def tree_by_computed_torque() -> Law:
    """Computed torque for a seven-axis arm with a known model."""
    follow = computed_torque(dynamics(tree_system(arm(coulomb=False).tree)), Gains(np.full(D, 400.0), np.full(D, 40.0)))
    return _tracking(follow, D)


def tree_by_feed_forward() -> Law:
    """Feed-forward for the same arm: the model is evaluated on the reference."""
    return _tracking(feed_forward(dynamics(tree_system(arm(coulomb=False).tree)), Gains(STIFFNESS, DAMPING)), D)


def network_by_computed_torque(d: int = 7, width: int = 32) -> Law:
    """Computed torque by a structured DeLaN of two layers with random parameters."""
    model = build(describe("structured-delan", precision="f64", needs=chain(d).needs, width=width, depth=2))
    random = np.random.default_rng(0)
    shapes = jax.eval_shape(model.init, jax.random.key(0))
    drawn = jax.tree.map(lambda leaf: random.normal(size=leaf.shape) / np.sqrt(leaf.shape[0]), shapes)
    system = dynamics(model.energies(jax.tree.map(lambda leaf: leaf.astype(np.float64), drawn)))
    return _tracking(computed_torque(system, Gains(np.full(d, 400.0), np.full(d, 40.0))), d)


def value_policy() -> Law:
    """Optimal control of a cart-pole by an untrained value network of two layers of 64."""
    problem = PLANTS["cart-pole"]().problem
    network = value_network(problem, widths=(64, 64), scale=30.0)
    parameters = network.init(jax.random.key(0))
    return Law(hjb_policy(lambda x: network.value_and_gradient(parameters, x), problem), (np.zeros(4),))


def one_iteration() -> Law:
    """A call of `prepare` for a cart-pole between walls over 1.2 s: (x, plan) -> plan."""
    problem = in_jax(cart_pole())
    return Law(*renewed(problem, first_plan(problem, HANGING, np.zeros((STEPS, 1)))))


LAWS: dict[str, Callable[[], Law]] = {
    "regulator": regulator,
    "swing_up": swing_up,
    "tree_feed_forward": tree_by_feed_forward,
    "tree_computed_torque": tree_by_computed_torque,
    "network_computed_torque": network_by_computed_torque,
    "value_policy": value_policy,
    "one_iteration": one_iteration,
}
"""Controllers by name."""


def laws(quick: bool) -> Findings:
    """Time of one call in microseconds."""
    rows: list[Row] = []
    effort = {"repeats": 3, "calls": 100, "cold": 50} if quick else {"repeats": 9, "calls": 1000, "cold": 1000}
    mebibytes = max(evicting(), LEAST_EVICTED)
    for name, make in LAWS.items():
        law = make()
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place) / name
            export_c({name: (law.function, law.examples)}, folder, stack=STACK)
            program = programs(folder, compiled(folder, folder), [name])[name]
            # A plan takes a hundred times as long as a control law.
            spent = {**effort, "calls": max(effort["calls"] // 20, 10)} if name == "one_iteration" else effort
            rows += rows_of(name, timed(program, mebibytes=mebibytes, **spent))
    rows.append(Row("laws", "emptied_by_mib", mebibytes, "MiB", expected="read before each cold call"))
    return Findings(rows)


def rows_of(name: str, times: Times) -> list[Row]:
    """Times of warm and cold calls, in microseconds."""
    case, cold = f"laws/{name}", np.percentile(times.cold, [50, 99.9]) / 1e3
    return [
        Row(case, "warm_us", float(np.median(times.hot)) / 1e3, "us"),
        Row(case, "cold_p50_us", float(cold[0]), "us"),
        Row(case, "cold_p999_us", float(cold[1]), "us"),
    ]


def _tracking(follow: Callable, d: int) -> Law:
    def law(q: Any, qd: Any, wanted_q: Any, wanted_qd: Any, wanted_qdd: Any) -> Any:
        return follow(q, qd, Reference(wanted_q, wanted_qd, wanted_qdd))

    return Law(law, (np.zeros(d),) * 5)
