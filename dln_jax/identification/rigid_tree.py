"""A robot as a model: friction with fitted shapes, and extra terms chosen by cross-validation.

An extra term always lowers the training error, whether or not the plant has it. `choose_terms` therefore keeps a term
only if it lowers the cross-validation error over trajectories (or blocks of time) by more than `MARGIN` standard
errors. The terms are coupled motors, friction by load, and friction by temperature.

`shared_motor` searches the unexplained torques of a fit for motors that turn with two joints, for example in coupled
wrists. A motor with the rate m = qd_j + c qd_i, i < j, has friction F(m), which acts on both joints:

    left_j = F_j(qd_j) + F(m),    left_i = F_i(qd_i) + c F(m),    F(v) = b v + k tanh(v / s)

Its share is the fraction that F(m) explains beyond friction by the joints' own rates; the smaller one of both joints.
"""

import functools
import itertools
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dln_jax.data.robots import Robot
from dln_jax.data.schema import Trajectories
from dln_jax.data.splits import BLOCKS, every, in_blocks
from dln_jax.identification.equations import determinacy
from dln_jax.identification.identify import STATES, random_states
from dln_jax.learning.friction import (
    FrictionFit,
    Known,
    Terms,
    equations,
    fit_friction,
    known_of,
    link_signs,
    solve_terms,
)
from dln_jax.learning.select import mean_of_segments, significantly_better
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction import FrictionShape
from dln_jax.mechanics.trees.description import Tree, tree_to_json
from dln_jax.mechanics.trees.motors import Pair
from dln_jax.models.model import Model, Parameters
from dln_jax.models.trees import Rows
from dln_jax.precision import compiled
from dln_jax.types import FrictionLaw, JointSamples, Needs
from dln_jax.zoo.descriptions import Description, build, describe

MOST_SAMPLES, FEWER_SAMPLES = 4_000, 2_000
"""Largest number of samples for fitting the shapes of friction, and for each fit of a cross-validation."""
FOLDS = 4
MARGIN = 2.0
"""A term must lower the error by this number of standard errors; chance does so in about one log in forty."""
RATIOS = (-2.0, -1.5, -1.0, -0.75, -0.5, -0.25, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0)
"""Trial values of c."""
SHARE = 0.3
"""Smallest share of the unexplained variance in both joints."""
SMOOTH = 0.1
"""Velocity scale s relative to the root mean square rate."""
MOST = 4000
"""Largest number of samples for finding a motor."""


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

    Returns the description, the friction fit if there is a shape to fit, and a line for each trial term.

    Args:
        robot: the robot.
        needs: needs of the tree with its friction laws; cross-validation decides on "load".
        train: training data.
        velocity_scale: velocity scale of dry friction, rad/s or m/s (default: fitted).
        cooling: whether viscous friction may fall with temperature.
        motors: rows of S in the motor rates S qd.
        coupled: pairs of joints with motors that may share an inertia.

    Raises:
        InputError: as for `fit_friction`.
    """
    tree, stated = robot.tree, {} if velocity_scale is None else {"velocity_scale": velocity_scale}
    laws: tuple[FrictionLaw, ...] = tuple(law for law in needs.joint_friction if law != "load")
    terms = Terms(laws, FrictionShape(**stated), tuple(stated), motors=motors)
    lines, additions = [], {}
    for pair in coupled:
        name = f"armature between the motors of joints {pair[0] + 1} and {pair[1] + 1}"
        if is_identifiable(tree, motors, pair):
            additions[name] = {"coupled": (pair,)}
        else:
            lines.append(f"{name}: left out, since other inertias explain its torques; state --motors if it is known")
    if "load" in needs.joint_friction:
        additions["friction by load"] = {"laws": ("load",)}
    if cooling:
        additions["friction by temperature"] = {"cooling": True}
    terms, _, tried = choose_terms(tree, train, terms, additions)
    lines += tried
    fitted, keywords = None, {"motors": motors, "coupled": terms.coupled, **stated}
    if terms.learned:
        fitted = fit_friction(tree, every(train, -(-len(train.t) // MOST_SAMPLES)), **terms._asdict())
        keywords = fitted.keywords
    needs = needs._replace(joint_friction=terms.laws)
    return describe("rigid-tree", precision="f64", needs=needs, tree=tree_to_json(tree), **keywords), fitted, lines


def build_rigid_tree(description: Description, robot: Robot) -> tuple[Model, Parameters]:
    """Builds the model of a description, with parameters from the robot's file."""
    model = build(description)
    known = model.init(jax.random.key(0))
    stated = {"viscous": robot.damping, "coulomb": robot.coulomb}
    return model, known._replace(
        **{name: jnp.asarray(values) for name, values in stated.items() if getattr(known, name) is not None}
    )


def is_identifiable(tree: Tree, motors: Rows | None, pair: Pair) -> bool:
    """Whether arbitrary motions distinguish the armature of a pair from the inertias of links and motors."""
    states = random_states(tree.joints, STATES * tree.degrees_of_freedom, 0)
    with jax.enable_x64(True):
        links = known_of(tree, states, Terms((), motors=motors, coupled=(pair,)), noise=1.0).links
    return determinacy(np.asarray(links).reshape(-1, links.shape[2]))[-1] == "alone"


def choose_terms(
    tree: Tree, data: Trajectories, terms: Terms, additions: Mapping[str, Mapping[str, Any]]
) -> tuple[Terms, list[str], list[str]]:
    """Tries additions one by one and keeps each that significantly lowers the cross-validation error.

    Returns the terms, the names of the kept additions, and a line for each addition. Errors are mean squares in
    cross-validation, summed over joints, in units of each torque's variance.

    Args:
        additions: name -> additions to entries of `terms`, such as {"laws": ("load",)}.

    Raises:
        InputError: as for `fit_friction`.
    """
    if not additions:
        return terms, [], []
    if len(np.unique(data.trajectory)) < FOLDS:
        data = in_blocks(data, BLOCKS)
    data = every(data, -(-len(data.t) // FEWER_SAMPLES))
    errors = cross_validate(tree, data, terms)
    names, lines = [], []
    for name, added in additions.items():
        wider = terms._replace(**{entry: getattr(terms, entry) + more for entry, more in added.items()})
        trial = cross_validate(tree, data, wider)
        kept = significantly_better(trial, errors, margin=MARGIN)
        lines.append(
            f"{name}: {'kept' if kept else 'left out'}; cross-validation error {trial.mean():.4g} with it, "
            f"{errors.mean():.4g} without"
        )
        if kept:
            names.append(name)
            terms, errors = wider, trial
    return terms, names, lines


def cross_validate(tree: Tree, data: Trajectories, terms: Terms) -> Float[np.ndarray, " segments"]:
    """Returns the mean squared error of each segment, from fits to the other folds."""
    fold_of = np.unique(data.trajectory, return_inverse=True)[1] % FOLDS
    fewest = len(fold_of) - np.bincount(fold_of).max()
    with jax.enable_x64(True):
        known, design = known_of(tree, data, terms), functools.partial(equations, terms)
        evaluate = jax.jit(design)
        squares = np.zeros(len(data.t))
        for fold in range(FOLDS):
            held, rest = fold_of == fold, np.flatnonzero(fold_of != fold)
            # Every fold has the same number of samples, so that one compiled program serves all.
            rows = rest[np.linspace(0, len(rest) - 1, fewest).round().astype(int)]
            solution = solve_terms(terms, Known(*(part[rows] for part in known)), design)
            whole = known._replace(signs=link_signs(terms, known, solution))
            A, b = map(np.asarray, evaluate(solution.nonlinear, whole))
            squares[held] = np.sum((A @ solution.linear - b).reshape(len(data.t), -1) ** 2, axis=1)[held]
    return mean_of_segments(data, squares)


def at_reference(
    description: Description, model: Model, parameters: Parameters, *logs: Trajectories
) -> list[Trajectories]:
    """Converts torques to the reference temperature, by the fitted friction; unchanged if it does not depend on it."""
    if not np.any(description["cooling"]):
        return list(logs)
    energies: Any = model.energies  # a rigid tree takes a temperature too

    def warmer(q: Any, qd: Any, temperature: Any) -> Any:
        reference = description["reference_temperature"]
        there, here = (dynamics(energies(parameters, at)).friction(q, qd) for at in (temperature, reference))
        return there - here

    change = compiled(jax.vmap(warmer))
    with jax.enable_x64(True):
        return [log._replace(tau=log.tau - np.asarray(change(log.q, log.qd, log.temperature))) for log in logs]


def shared_motor(left: JointSamples, qd: JointSamples) -> tuple[int, int, float, float] | None:
    """Returns j, i (from 0), c and the share of the best motor; `None` if no motor explains enough."""
    from scipy.linalg import block_diag  # imported here, after commands have set BLAS's threads

    scale, best = left.std(axis=0), None
    moving = np.flatnonzero((scale > 0) & (qd.std(axis=0) > 0))
    for j, i in itertools.combinations(moving[::-1], 2):
        own = [np.column_stack([_friction(qd[:, k]), np.ones(len(qd))]) for k in (j, i)]
        alone, y = np.asarray(block_diag(*own)), np.concatenate([left[:, k] / scale[k] for k in (j, i)])
        before = _unexplained(alone, y)
        for c in RATIOS:
            of_motor = _friction(qd[:, j] + c * qd[:, i])
            on_both = np.concatenate([of_motor / scale[j], c * of_motor / scale[i]])
            share = float(np.min(1 - _unexplained(np.column_stack([alone, on_both]), y) / before))
            if share >= SHARE and (best is None or share > best[3]):
                best = int(j), int(i), c, share
    return best


def _friction(rate: np.ndarray) -> np.ndarray:
    return np.column_stack([rate, np.tanh(rate / (SMOOTH * np.sqrt(np.mean(rate**2)) + 1e-300))])


def _unexplained(A: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Returns the mean squared residual of least squares for both joints."""
    left = y - A @ np.linalg.lstsq(A, y, rcond=None)[0]
    return np.mean(left.reshape(2, -1) ** 2, axis=1) + 1e-300
