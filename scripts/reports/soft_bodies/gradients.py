"""The crawler: gradients of its motion against finite differences, and the time of its steps and of reverse mode."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from dln_jax.rollout import rollout
from dln_jax.softbody import SoftScene, make_step, positions_and_convergence, with_parameters
from dln_jax.softbody.examples import creature_scene
from dln_jax.softbody.mesh import shapes
from dln_jax.softbody.terms.creature import TIME_STEP
from scripts.reports.run import Numbers
from scripts.reports.timing import medians_in_turns

LANES = 64
Loss = Callable[[dict[str, Any]], Array]


def crawler(*, contact_steps: int = 100) -> Numbers:
    """Reverse mode for everything, over contact steps with ground, friction and muscles.

    For each quantity theta with gradient g, the slope along d = g/|g| is |g|; against it stand central differences of
    fourth order,

        D(e) = (8 (L(e) - L(-e)) - (L(2 e) - L(-2 e))) / 12 e,    L(e) = L(theta + e d)

    for steps e that halve. The quotient that changes least from the previous step counts, a rule that does not depend
    on the gradient.
    """
    loss, at = crawling(contact_steps, tolerance=1e-9)  # m/s²: differences need more digits than motions
    gradients = jax.jit(jax.grad(loss))(at)

    def moved(direction: dict[str, Any], length: Array) -> Array:
        return loss(jax.tree.map(lambda leaf, slope: leaf + length * slope, at, direction))

    program, errors = jax.jit(jax.vmap(moved, in_axes=(None, 0))), {}
    for key, gradient in gradients.items():
        slope = float(jnp.sqrt(jnp.sum(gradient**2)))
        direction = {name: leaf / slope if name == key else 0 * leaf for name, leaf in gradients.items()}
        # The unit of steps is the largest entry, or 1 for zeros.
        lengths = (float(jnp.max(jnp.abs(at[key]))) or 1.0) * 2.0 ** -np.arange(8, 22)
        ahead, behind = np.asarray(program(direction, np.concatenate([lengths, -lengths]))).reshape(2, -1)
        central = ahead - behind
        fourth = (8 * central[1:] - central[:-1]) / (12 * lengths[1:])
        best = fourth[1 + np.argmin(abs(np.diff(fourth)))]
        errors[f"{key}_relative_error"] = abs(best / slope - 1)
    return {"gradient/crawler": errors}


def creature(*, steps: int = 1000) -> Numbers:
    """Steps per second of one crawler, and of many gaits side by side by vmap, 100 steps each."""
    scene, muscles = crawling_scene()
    init, step = make_step(scene, TIME_STEP)

    def run(controls: Any) -> Any:
        return rollout(functools.partial(step, scene.params), init(), controls, observe=positions_and_convergence)[1]

    controls = gait(steps, muscles)
    lanes = gait(100, muscles) * jnp.linspace(0.8, 1.0, LANES)[:, None, None]
    alone, together = jax.jit(run), jax.jit(jax.vmap(lambda controls: run(controls)[0][-1]))
    seconds, lanes_seconds = (
        medians_in_turns({"": program}, (inputs,), repetitions=9)[""]
        for program, inputs in ((alone, controls), (together, lanes))
    )
    return {
        "speed/crawler": {
            "steps_per_second": steps / seconds,
            "steps_not_converged": np.sum(~np.asarray(alone(controls)[1])),
        },
        f"speed/{LANES}-crawlers": {"environment_steps_per_second": 100 * LANES / lanes_seconds},
    }


def backward(*, repetitions: int = 30) -> Numbers:
    """Time of reverse mode over that of the motion itself, 100 steps of the crawler."""
    loss, at = crawling(100, tolerance=1e-6)

    def slopes(at: Any, names: list[str]) -> Any:
        return jax.value_and_grad(lambda part: loss({**at, **part}))({name: at[name] for name in names})

    chosen = {"controls": ["controls"], "everything": list(at)}
    programs = {name: jax.jit(functools.partial(slopes, names=names)) for name, names in chosen.items()}
    seconds = medians_in_turns({"motion": jax.jit(loss), **programs}, (at,), repetitions=repetitions)
    return {
        f"speed/gradient-by-{name}": {"backward_over_forward": seconds[name] / seconds["motion"] - 1}
        for name in programs
    }


def crawling_scene() -> tuple[SoftScene, int]:
    """The preset crawler of 28 vertices, and its number of muscles."""
    body = shapes.crawler()
    return creature_scene(body), len(body.muscles)


def gait(steps: int, muscles: int) -> Array:
    """Actuation [steps, muscles]: a wave of muscle lengths of 0.7 to 1 that runs along the body."""
    phase = 2 * np.pi * (np.arange(steps)[:, None] / 20 - np.arange(muscles) / muscles)
    return jnp.asarray(0.85 + 0.15 * np.sin(phase))


def crawling(steps: int, *, tolerance: float) -> tuple[Loss, dict[str, Any]]:
    """Distance of the crawler, m, plus terms of its shape and velocity, as a function of its inputs; and these."""
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
        params = with_parameters(
            scene.params._replace(rest=at["rest_shape"], masses=at["masses"]),
            elastic={"mu": at["mu"], "lam": at["lambda"]},
            muscles={"stiffness": at["muscle_stiffness"]},
            ground={"stiffness": at["ground_stiffness"], "friction": at["friction"]},
        )
        start = init(at["x0"], at["v0"])
        last, _ = rollout(functools.partial(step, params), start, at["controls"], observe=lambda state, info: None)
        return last.x[:, 0].mean() + 0.1 * (last.x[:, 1] ** 2).sum() + 0.1 * last.v[0, 0]

    return loss, jax.tree.map(jnp.asarray, at)
