"""Gradients of motions against finite differences along the gradient itself.

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
from dln_jax.softbody.mesh.shapes import beam
from dln_jax.softbody.scene import Params, SoftScene, State, make_scene, with_parameters
from dln_jax.softbody.step import Step, make_step
from dln_jax.softbody.terms.contact import plane_contact
from dln_jax.softbody.terms.creature import TIME_STEP
from dln_jax.softbody.terms.gravity import gravity
from dln_jax.softbody.terms.springs import springs
from scripts.reports.case import Findings
from scripts.reports.rows import expect
from scripts.reports.soft_bodies.common import GRAVITY, solid

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
    return _compared("crawler", loss, at)


def modes(quick: bool) -> Findings:
    """Forward against reverse mode, `vmap` against one by one, and second derivatives, of springs that swing."""
    loss, at = _swinging(10)
    # NumPy arrays from here on: every JAX operation outside a program would be compiled as its own program.
    at, compiled = jax.tree.map(np.asarray, at), jax.jit(jax.grad(loss))

    def slopes(at: Any) -> Any:
        return jax.tree.map(np.asarray, compiled(at))

    reverse = slopes(at)
    random = np.random.default_rng(0)
    # One per cent of every quantity, so that all of them count.
    along = jax.tree.map(lambda leaf: 0.01 * _size(leaf) * random.normal(size=leaf.shape), at)
    _, forward = jax.jit(lambda at: jax.jvp(loss, (at,), (along,)))(at)
    inner = _inner(reverse, along)
    text = "Jᵀ and J of one motion agree to rounding"
    cases = [expect("modes/forward", "relative_difference", text, float(abs(forward / inner - 1)), 1e-10)]
    near = jax.tree.map(lambda leaf, change: np.stack([leaf, leaf + 0.1 * change]), at, along)
    lanes = jax.tree.map(np.asarray, jax.jit(jax.vmap(jax.grad(loss)))(near))
    second = jax.tree.map(lambda leaf: leaf[1], near)
    both = [
        _distance(jax.tree.map(lambda leaf, k=k: leaf[k], lanes), one)
        for k, one in enumerate((reverse, slopes(second)))
    ]
    text = "lanes that take different numbers of iterations do not disturb each other"
    cases.append(expect("modes/vmap", "relative_difference", text, max(both), 1e-8))
    _, product = jax.jit(lambda at: jax.jvp(jax.grad(loss), (at,), (along,)))(at)

    def shifted(e: float):
        return slopes(jax.tree.map(lambda leaf, change: leaf + e * change, at, along))

    steps = 2.0 ** -np.arange(3, 12)
    central = [jax.tree.map(np.subtract, shifted(e), shifted(-e)) for e in steps]
    differences = [
        jax.tree.map(lambda near, far, e=e: (8 * near - far) / (12 * e), near, far)
        for e, near, far in zip(steps[1:], central[1:], central, strict=False)
    ]
    changes = [_distance(a, b) for a, b in zip(differences[1:], differences, strict=False)]
    chosen = differences[1 + int(np.argmin(changes))]
    text = "Hessian-vector product against differences of the gradient"
    cases.append(expect("modes/nested", "relative_difference", text, _distance(chosen, product), 1e-6))
    return Findings(cases)


def coulomb(quick: bool) -> Findings:
    """A beam that slides and bounces on a plane with Coulomb friction: E, nu, friction, stiffness of the plane, v0."""
    mesh = beam(1.0, 0.25, 4, 1)
    ground = plane_contact(
        np.arange(len(mesh.vertices)),
        normal=(0.0, 1.0),
        offset=-0.02,
        stiffness=1e5,
        width=1e-2,
        friction=0.3,
        threshold_speed=0.1,
    )
    scene = solid(mesh, ground, modulus=1e5)
    init, step = make_step(scene, 0.01, tolerance=TOLERANCE)
    terms = scene.params.terms
    at = {
        "youngs_modulus": terms["elastic"].youngs_modulus,
        "poisson_ratio": terms["elastic"].poisson_ratio,
        "friction": terms["ground"].friction,
        "ground_stiffness": terms["ground"].stiffness,
        "v0": init(v=(2.0, 0.0)).v,
    }

    def loss(at: dict[str, Array]) -> Array:
        params = with_parameters(
            scene.params,
            elastic={"youngs_modulus": at["youngs_modulus"], "poisson_ratio": at["poisson_ratio"]},
            ground={"friction": at["friction"], "stiffness": at["ground_stiffness"]},
        )
        return _objective(step, init(v=at["v0"]), params, None, 20 if quick else 50)

    return _compared("sliding-beam", loss, at)


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
        params = with_parameters(
            scene.params._replace(rest=at["rest_shape"], masses=at["masses"]),
            elastic={"mu": at["mu"], "lam": at["lambda"]},
            muscles={"stiffness": at["muscle_stiffness"]},
            ground={"stiffness": at["ground_stiffness"], "friction": at["friction"]},
        )
        return _objective(step, init(at["x0"], at["v0"]), params, at["controls"])

    return loss, at


def _swinging(steps: int) -> tuple[Loss, dict[str, Any]]:
    """Springs that hang from a vertex, a scene that compiles fast, as four programs are made of it."""
    mesh = beam(1.0, 0.5, 1, 1)
    pairs = [[0, 1], [1, 3], [3, 2], [2, 0], [0, 3]]
    scene = make_scene(mesh, [springs(pairs, stiffness=2e4), gravity(mesh, (0.0, -GRAVITY))], held=[0])
    init, step = make_step(scene, 0.01, tolerance=TOLERANCE)
    at = {
        "stiffness": jnp.full(len(pairs), 2e4),
        "rest_shape": scene.params.rest,
        "v0": init(v=np.array([[0.0, 0.0], [1.0, -0.2], [0.3, 0.0], [1.0, 0.5]])).v,
    }

    def loss(at: dict[str, Array]) -> Array:
        params = with_parameters(scene.params._replace(rest=at["rest_shape"]), springs={"stiffness": at["stiffness"]})
        return _objective(step, init(v=at["v0"]), params, None, steps)

    return loss, at


def _objective(step: Step, start: State, params: Params, controls: Any, steps: int | None = None) -> Array:
    """Distance of the body, m, plus terms of its shape and velocity."""
    last, _ = rollout(functools.partial(step, params), start, controls, steps=steps, observe=lambda state, info: None)
    return last.x[:, 0].mean() + 0.1 * (last.x[:, 1] ** 2).sum() + 0.1 * last.v[0, 0]


def _compared(name: str, loss: Loss, at: dict[str, Any]) -> Findings:
    at = {key: np.asarray(leaf) for key, leaf in at.items()}
    value, slopes = jax.tree.map(np.asarray, jax.jit(jax.value_and_grad(loss))(at))
    sizes = {key: np.sqrt(np.sum(leaf**2)) for key, leaf in slopes.items()}
    directions = {key: leaf / sizes[key] for key, leaf in slopes.items()}
    lengths = LARGEST_STEP * 2.0 ** -np.arange(HALVINGS)
    lengths = np.concatenate([lengths, -lengths])
    scales = {key: _size(leaf) for key, leaf in at.items()}
    chosen = np.repeat(np.arange(len(at)), len(lengths))
    tried = np.concatenate([lengths * scales[key] for key in at])

    def moved(group: Array, length: Array) -> Array:
        shifts = {key: jnp.where(group == number, length, 0.0) for number, key in enumerate(at)}
        return loss({key: leaf + shifts[key] * directions[key] for key, leaf in at.items()})

    values = np.asarray(jax.jit(jax.vmap(moved))(chosen, tried)).reshape(len(at), 2, HALVINGS)
    cases, curves = [], {"relative_steps": lengths[1:HALVINGS], "errors": {}}
    text = f"the slope along the gradient, by central differences (motion ends at {float(value):.3g})"
    for number, key in enumerate(at):
        ahead, behind = values[number]
        e = lengths[:HALVINGS] * scales[key]
        fourth = (8 * (ahead - behind)[1:] - (ahead - behind)[:-1]) / (12 * e[1:])
        best = 1 + int(np.argmin(abs(np.diff(fourth))))
        slope = float(sizes[key])
        curves["errors"][key] = abs(fourth / slope - 1)
        error = float(abs(fourth[best] / slope - 1))
        cases.append(expect(f"gradient/{name}", f"{key}_relative_error", text, error, BOUND, reference=slope))
    return Findings(cases, curves)


def _size(leaf: Any) -> float:
    """The unit of steps: the largest entry, or 1 for zeros."""
    return float(np.max(np.abs(np.asarray(leaf)))) or 1.0


def _inner(left: Any, right: Any) -> float:
    return sum(float(np.vdot(a, b)) for a, b in zip(jax.tree.leaves(left), jax.tree.leaves(right), strict=True))


def _distance(left: Any, right: Any) -> float:
    """Largest difference of two trees' leaves, each relative to its own size."""
    pairs = zip(jax.tree.leaves(left), jax.tree.leaves(right), strict=True)
    return max(float(np.linalg.norm(np.asarray(a - b)) / np.linalg.norm(np.asarray(b))) for a, b in pairs)
