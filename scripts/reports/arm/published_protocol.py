"""The structured DeLaN by the published protocol against the published code, and mechanics against textbook formulas.

64x64 tanh, batch 512, 20,000 steps, float32. The generic mechanics is compared with the arm's closed form in float64.
"""

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.cli.progress import progress
from dln_jax.data.splits import Split
from dln_jax.mechanics import closed_form
from dln_jax.mechanics.equations import dynamics
from dln_jax.metrics.errors import errors
from dln_jax.scenes.pendulums import two_link_arm
from dln_jax.scenes.scene import Scene, closed_form_forward_dynamics
from dln_jax.zoo.run import compiled
from scripts.reports.arm.models import by_published_protocol, latency
from scripts.reports.arm.table import ARM_UNITS
from scripts.reports.case import Case, Findings
from scripts.reports.predictions import predictions
from scripts.reports.published import ARM, PUBLISHED_CODE, published
from scripts.reports.rows import Row, unit_of

KIND = "structured-delan"
BOUNDS = {
    "torque_mse": 3e-6,
    "inertial_mse": 1e-5,
    "coriolis_mse": 1e-5,
    "gravity_mse": 1e-5,
    "train_seconds": 45.0,
    "one_step_p50_us": 111.0 / 3,
}


def cases(name: str, sets: Sequence[Split], *, steps: int) -> list[Case]:
    """The textbook comparison, and one training per split, seeded by the split's index; `name` names the data."""
    names = [f"{KIND}/{name}/seed-{seed}" for seed in range(len(sets))]
    return [
        Case(f"textbook/{two_link_arm().name}", partial(textbook, two_link_arm())),
        *(Case(case, partial(trained, case, sets[seed], seed=seed, steps=steps)) for seed, case in enumerate(names)),
    ]


def trained(case: str, sets: Split, *, seed: int, steps: int) -> Findings:
    """Trains one seed and measures all quantities of the published table."""
    with progress(steps) as show:
        report = lambda at: show(min(int(at.step), steps), f"{case}  loss {at.loss:.2e}")  # noqa: E731
        training, energies = by_published_protocol(KIND, sets, steps=steps, seed=seed, report=report)
    timed = latency(compiled(dynamics(energies), jnp.float32), sets, jnp.float32, calls=5000)
    numbers = {
        **errors(predictions(energies, sets.test, jnp.float32), sets.test),
        "train_seconds": training.train_seconds,
        "compile_seconds": training.compile_seconds,
        "one_step_p50_us": timed.p50_us,
        "one_step_p99_us": timed.p99_us,
    }
    return Findings([beside(Row(case, key, value)) for key, value in numbers.items()])


def beside(row: Row) -> Row:
    """Adds unit, published reference (of the protocol, else of the published code) and bound to a row."""
    of_protocol = published(ARM, f"{KIND}/characters", row.quantity)
    reference = published(PUBLISHED_CODE, KIND, row.quantity) if of_protocol is None else of_protocol
    return row._replace(unit=unit_of(row.quantity, ARM_UNITS), reference=reference, bound=BOUNDS.get(row.quantity))


def textbook(scene: Scene, *, states: int = 1000) -> Findings:
    """Largest error of the generic Lagrangian mechanics in float64, relative to the largest magnitude."""
    q, qd, qdd, tau = np.random.default_rng(0).uniform(-np.pi, np.pi, (4, states, scene.needs.degrees_of_freedom))
    generic = dynamics(scene.energies)
    pairs = {
        "inverse": (generic.inverse_dynamics, partial(closed_form.inverse_dynamics, scene.closed_form), qdd),
        "forward": (generic.forward_dynamics, partial(closed_form_forward_dynamics, scene), tau),
    }
    rows = []
    for name, (derived, textbook_formula, last) in pairs.items():
        computed = jax.jit(jax.vmap(derived))(q, qd, last)
        expected = jax.jit(jax.vmap(textbook_formula))(q, qd, last)
        error = float(jnp.max(jnp.abs(computed - expected)) / jnp.max(jnp.abs(expected)))
        rows.append(Row(f"textbook/{scene.name}", f"{name}_relative_error", error, "1", 0.0, 1e-12))
    return Findings(rows)
