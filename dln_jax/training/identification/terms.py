"""Terms of the robot that identify may add: coupled motors, friction by load and by temperature."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from dln_jax.compilation import quick_compilation
from dln_jax.data.schema import Trajectories
from dln_jax.identification.base import DEPENDENT, unit_columns
from dln_jax.identification.identify import STATES, random_states
from dln_jax.learning.friction_selection import TriedTerm, choose_terms
from dln_jax.learning.friction_terms import Terms, log_of, reference_temperature, terms_of
from dln_jax.mechanics.equations import dynamics
from dln_jax.mechanics.friction.laws import FrictionShape
from dln_jax.mechanics.trees.description import Tree
from dln_jax.mechanics.trees.motors import Pair, require_motors
from dln_jax.models.model import Model, Parameters
from dln_jax.runs.arguments import names_listed, numbers_of
from dln_jax.types import FrictionLaw, InputError


class Wanted(NamedTuple):
    """Terms that the options name."""

    load: bool = False
    cooling: bool = False
    motors: tuple[tuple[float, ...], ...] | None = None
    coupled: tuple[Pair, ...] = ()


def wanted(options: Any, laws: tuple[FrictionLaw, ...], data: Trajectories) -> Wanted:
    """Parses and checks the options; `InputError` for invalid motors or pairs, or a temperature that the data lack."""
    rows, pairs, d = None, [], data.degrees_of_freedom
    if options.motors is not None:
        rows = tuple(numbers_of("--motors", row, [d]) for row in options.motors.split(";"))
        if len(rows) != d:
            raise InputError(
                f"--motors has {len(rows)} rows; expected {d}, one for each motor, separated by semicolons"
            )
    for text in names_listed(options.coupled):
        joints = text.partition(":")[::2]
        if not all(joint.strip().isdecimal() for joint in joints):
            raise InputError(f"--coupled has {text!r:.40}; expected pairs of joints such as 2:3")
        first, second = sorted(int(joint) - 1 for joint in joints)
        pairs.append((first, second))
    try:
        require_motors(rows, pairs, d)
    except InputError as error:
        raise InputError(f"--{error}") from None
    if options.temperature:
        if not {"viscous", "asymmetric"} & set(laws):
            raise InputError("--temperature changes viscous friction, which --friction lacks; add viscous to it")
        reference_temperature(data)
    return Wanted("load" in laws, options.temperature, rows, tuple(pairs))


def chosen(
    wanted: Wanted, tree: Tree, train: Trajectories, laws: tuple[FrictionLaw, ...], start: FrictionShape,
    held: tuple[str, ...],
) -> tuple[Terms, list[str]]:  # fmt: skip
    """Terms that cross-validation keeps, and lines on all that were tried."""
    plain: tuple[FrictionLaw, ...] = tuple(law for law in laws if law != "load")
    options: dict[str, Any] = {"cooling": False, "motors": wanted.motors, "coupled": ()}
    terms, lines, candidates = terms_of(plain, start, held, **options), [], []
    for pair in wanted.coupled:
        name = f"armature between the motors of joints {pair[0] + 1} and {pair[1] + 1}"
        if not is_identifiable(tree, terms, pair):
            lines.append(f"{name}: left out, as other inertias explain all its torques; state --motors if it is known")
            continue
        candidates.append((name, terms._replace(coupled=(pair,))))
    if wanted.load:
        candidates.append(("friction by load", terms_of(("load",), start, held, **options)))
    if wanted.cooling:
        candidates.append(("friction by temperature", terms._replace(learned=("cooling",))))
    terms, tried = choose_terms(tree, train, terms, candidates)
    return terms, [*lines, *map(line_on, tried)]


def line_on(term: TriedTerm) -> str:
    """Line on a term that cross-validation tried."""
    verdict = "kept" if term.kept else "left out"
    return f"{term.name}: {verdict}; cross-validation error {term.within:.4g} with it, {term.without:.4g} without"


def is_identifiable(tree: Tree, terms: Terms, pair: Pair) -> bool:
    """Whether torques of arbitrary motions tell the armature of a pair from inertias of links and motors."""
    states = random_states(tree.joints, STATES * tree.degrees_of_freedom, 0)
    with jax.enable_x64(True):
        log = log_of(tree, states, terms._replace(laws=(), learned=(), coupled=(*terms.coupled, pair)), noise=1.0)
    A = unit_columns(np.asarray(log.links).reshape(-1, log.links.shape[2]))[0]
    others, column = A[:, :-1], A[:, -1]
    left = column - others @ np.linalg.lstsq(others, column, rcond=DEPENDENT)[0]
    return bool(np.linalg.norm(left) > np.sqrt(DEPENDENT))


def at_reference(model: Model, parameters: Parameters, reference: float) -> Callable[[Trajectories], Trajectories]:
    """Function that replaces torques by those at the reference temperature, by the friction of a fit."""
    energies: Any = model.energies  # of a rigid tree, which takes a temperature too

    def warmer(q: Any, qd: Any, temperature: Any) -> Any:
        there, here = (dynamics(energies(parameters, at)).friction(q, qd) for at in (temperature, reference))
        return there - here

    every = jax.jit(jax.vmap(warmer), compiler_options=quick_compilation())

    def referred(data: Trajectories) -> Trajectories:
        with jax.enable_x64(True):
            return data._replace(tau=data.tau - np.asarray(every(data.q, data.qd, data.temperature)))

    return referred
