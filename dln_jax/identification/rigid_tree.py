"""A robot as a model: friction with fitted shapes, and terms that only cross-validation adds.

Such terms are coupled motors, friction by load and friction by temperature.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.data.robots import Robot
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import every
from dln_jax.identification.base import DEPENDENT, unit_columns
from dln_jax.identification.identify import STATES, random_states
from dln_jax.learning.friction import FrictionFit, Terms, choose_terms, fit_friction, known_of, terms_of
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction.laws import FrictionShape
from dln_jax.mechanics.trees.description import Tree, tree_to_json
from dln_jax.mechanics.trees.motors import Pair
from dln_jax.models.model import Model, Parameters
from dln_jax.models.trees import Rows
from dln_jax.precision import quick_compilation
from dln_jax.types import Needs
from dln_jax.zoo.descriptions import Description, build, describe

MOST_SAMPLES = 4_000
"""Largest number of samples used to fit the shapes of friction."""


def describe_rigid_tree(
    robot: Robot,
    needs: Needs,
    train: Trajectories,
    *,
    velocity_scale: float | None = None,
    cooling: bool = False,
    motors: Rows | None = None,
    coupled: tuple[Pair, ...] = (),
) -> tuple[Description, FrictionFit | None, list[str]]:
    """Describes a robot with the terms that cross-validation keeps, and fits the shapes of its friction.

    Returns the description, the fit of friction if it has a shape to fit, and a line on every term that was tried.

    Args:
        needs: needs of the tree, with its friction laws; "load" is kept only if cross-validation favours it.
        velocity_scale: that of dry friction, rad/s or m/s (default: fitted).
        cooling: whether viscous friction may fall with temperature.
        motors: rows of S in the motor rates S qd.
        coupled: pairs of joints whose motors may share an inertia.

    Raises:
        InputError: as for `fit_friction`.
    """
    tree, scale = robot.tree, {} if velocity_scale is None else {"velocity_scale": velocity_scale}
    start, held = FrictionShape(**scale), tuple(scale)
    terms = terms_of(tuple(law for law in needs.joint_friction if law != "load"), start, held, motors=motors)
    lines, candidates = [], []
    for pair in coupled:
        name = f"armature between the motors of joints {pair[0] + 1} and {pair[1] + 1}"
        if is_identifiable(tree, terms, pair):
            candidates.append((name, terms._replace(coupled=(pair,))))
        else:
            lines.append(f"{name}: left out, as other inertias explain all its torques; state --motors if it is known")
    if "load" in needs.joint_friction:
        candidates.append(("friction by load", terms_of(("load",), start, held, motors=motors)))
    if cooling:
        candidates.append(("friction by temperature", terms._replace(learned=("cooling",))))
    terms, tried = choose_terms(tree, train, terms, candidates)
    lines += [
        f"{term.name}: {'kept' if term.kept else 'left out'}; cross-validation error {term.within:.4g} with it, "
        f"{term.without:.4g} without"
        for term in tried
    ]
    fitted = None
    keywords: dict[str, Any] = {"motors": motors, "coupled": terms.coupled, **scale}
    if terms.learned:
        fitted = fit_friction(
            tree,
            every(train, -(-len(train.t) // MOST_SAMPLES)),
            terms.laws,
            shape=start,
            held=held,
            cooling="cooling" in terms.learned,
            motors=motors,
            coupled=terms.coupled,
        )
        keywords |= {name: values.tolist() for name, values in fitted.shape.items()}
        if fitted.reference_temperature is not None:
            keywords["reference_temperature"] = fitted.reference_temperature
    needs = needs._replace(joint_friction=terms.laws)
    return describe("rigid-tree", precision="f64", needs=needs, tree=tree_to_json(tree), **keywords), fitted, lines


def build_rigid_tree(description: Description, robot: Robot) -> tuple[Model, Parameters]:
    """The model of a description, and its parameters by the robot's file."""
    model = build(description)
    known = model.init(jax.random.key(0))
    stated = {"viscous": robot.damping, "coulomb": robot.coulomb}
    return model, known._replace(
        **{name: jnp.asarray(values) for name, values in stated.items() if getattr(known, name) is not None}
    )


def is_identifiable(tree: Tree, terms: Terms, pair: Pair) -> bool:
    """Whether torques of arbitrary motions tell the armature of a pair from inertias of links and motors."""
    states = random_states(tree.joints, STATES * tree.degrees_of_freedom, 0)
    with jax.enable_x64(True):
        links = known_of(
            tree, states, terms._replace(laws=(), learned=(), coupled=(*terms.coupled, pair)), noise=1.0
        ).links
    A = unit_columns(np.asarray(links).reshape(-1, links.shape[2]))[0]
    others, column = A[:, :-1], A[:, -1]
    left = column - others @ np.linalg.lstsq(others, column, rcond=DEPENDENT)[0]
    return bool(np.linalg.norm(left) > np.sqrt(DEPENDENT))


def at_reference(
    description: Description, model: Model, parameters: Parameters, *logs: Trajectories
) -> list[Trajectories]:
    """Logs with the torques at the reference temperature, by the friction of a fit; unchanged without such friction."""
    if not np.any(description["cooling"]):
        return list(logs)
    energies: Any = model.energies  # of a rigid tree, which takes a temperature too

    def warmer(q: Any, qd: Any, temperature: Any) -> Any:
        reference = description["reference_temperature"]
        there, here = (dynamics(energies(parameters, at)).friction(q, qd) for at in (temperature, reference))
        return there - here

    change = jax.jit(jax.vmap(warmer), compiler_options=quick_compilation())
    with jax.enable_x64(True):
        return [log._replace(tau=log.tau - np.asarray(change(log.q, log.qd, log.temperature))) for log in logs]
