"""Gradients of a motion against finite differences along the gradient itself.

For each quantity theta with gradient g, the slope along d = g/|g| is |g|; against it stand central differences of
fourth order,

    D(e) = (8 (L(e) - L(-e)) - (L(2 e) - L(-2 e))) / 12 e,    L(e) = L(theta + e d)

for steps e that halve. The quotient that changes least from the previous step counts, a rule that does not depend on
the gradient.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from dln_jax.rollout import rollout
from dln_jax.softbody.examples import creature_scene
from dln_jax.softbody.mesh import shapes
from dln_jax.softbody.scene import SoftScene, with_parameters
from dln_jax.softbody.step import make_step
from dln_jax.softbody.terms.creature import TIME_STEP
from scripts.reports.case import Findings
from scripts.reports.rows import expect

BOUND = 1e-7
STEPS = 100
TOLERANCE = 1e-9
"""Tolerance of the steps, m/s²: differences need more digits than motions."""
HALVINGS = 14
LARGEST_STEP = 2.0**-8
"""Largest step e, relative to the size of theta."""

Loss = Callable[[dict[str, Any]], Array]


def crawler(quick: bool) -> Findings:
    """A crawler of 28 vertices over contact steps with ground, friction and muscles: reverse mode for everything."""
    loss, at = crawling(40 if quick else STEPS)
    at = {key: np.asarray(leaf) for key, leaf in at.items()}
    value, gradients = jax.tree.map(np.asarray, jax.jit(jax.value_and_grad(loss))(at))
    slopes = {key: np.sqrt(np.sum(leaf**2)) for key, leaf in gradients.items()}
    directions = {key: leaf / slopes[key] for key, leaf in gradients.items()}
    # The unit of steps is the largest entry, or 1 for zeros.
    scales = {key: float(np.max(np.abs(leaf))) or 1.0 for key, leaf in at.items()}
    lengths = LARGEST_STEP * 2.0 ** -np.arange(HALVINGS)
    both = np.concatenate([lengths, -lengths])

    def moved(group: Array, length: Array) -> Array:
        shifts = {key: jnp.where(group == number, length, 0.0) for number, key in enumerate(at)}
        return loss({key: leaf + shifts[key] * directions[key] for key, leaf in at.items()})

    groups, tried = np.repeat(np.arange(len(at)), len(both)), np.concatenate([both * scales[key] for key in at])
    values = np.asarray(jax.jit(jax.vmap(moved))(groups, tried)).reshape(len(at), 2, HALVINGS)
    text = f"the slope along the gradient, by central differences (motion ends at {float(value):.3g})"
    rows = []
    for key, (ahead, behind) in zip(at, values, strict=True):
        central = ahead - behind
        fourth = (8 * central[1:] - central[:-1]) / (12 * lengths[1:] * scales[key])
        best = fourth[1 + np.argmin(abs(np.diff(fourth)))]
        slope = float(slopes[key])
        rows.append(
            expect("gradient/crawler", f"{key}_relative_error", text, abs(best / slope - 1), BOUND, reference=slope)
        )
    return Findings(rows)


def crawling_scene() -> tuple[SoftScene, int]:
    """The preset crawler and its number of muscles."""
    body = shapes.crawler()
    return creature_scene(body), len(body.muscles)


def gait(steps: int, muscles: int) -> Array:
    """Actuation [steps, muscles]: a wave of muscle lengths of 0.7 to 1 that runs along the body."""
    phase = 2 * np.pi * (np.arange(steps)[:, None] / 20 - np.arange(muscles) / muscles)
    return jnp.asarray(0.85 + 0.15 * np.sin(phase))


def crawling(steps: int, tolerance: float = TOLERANCE) -> tuple[Loss, dict[str, Any]]:
    """Distance of the crawler as a function of all its inputs, and the point of evaluation."""
    scene, muscles = crawling_scene()
    init, step = make_step(scene, TIME_STEP, tolerance=tolerance)
    terms, start = scene.params.terms, init()
    at = {
        "controls": gait(steps, muscles),
        "mu": terms["elastic"].mu,
        "lambda": terms["elastic"].lam,
        "muscle_stiffness": terms["muscles"].stiffness,
        "ground_stiffness": terms["ground"].stiffness,
        "friction": terms["ground"].friction,
        "rest_shape": scene.params.rest,
        "masses": scene.params.masses,
        "x0": start.x,
        "v0": start.v,
    }

    def loss(at: dict[str, Array]) -> Array:
        """Distance of the body, m, plus terms of its shape and velocity."""
        params = with_parameters(
            scene.params._replace(rest=at["rest_shape"], masses=at["masses"]),
            elastic={"mu": at["mu"], "lam": at["lambda"]},
            muscles={"stiffness": at["muscle_stiffness"]},
            ground={"stiffness": at["ground_stiffness"], "friction": at["friction"]},
        )
        start = init(at["x0"], at["v0"])
        last, _ = rollout(functools.partial(step, params), start, at["controls"], observe=lambda state, info: None)
        return last.x[:, 0].mean() + 0.1 * (last.x[:, 1] ** 2).sum() + 0.1 * last.v[0, 0]

    return loss, at
