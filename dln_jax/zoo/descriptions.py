"""Model descriptions: JSON values that rebuild a model exactly, independently of any future defaults.

A description has `name`, `precision` (f32 or f64), and every keyword in the signature of the name's factory (except
`dtype`, which follows from the precision). The name is a catalogue name, "package.module:function" for your own
importable factory, or "own" for a factory that you pass again when you load the model.
"""

import contextlib
import functools
import importlib
import inspect
import json
import math
import reprlib
from collections.abc import Callable, Collection, Mapping
from typing import Any, Literal, get_args, get_origin

import numpy as np

from dln_jax.data.arrays import spread
from dln_jax.data.joints import needs_from_json
from dln_jax.data.schema import Trajectories
from dln_jax.errors import require_network
from dln_jax.files import as_type
from dln_jax.nn.activations import Activation, activation
from dln_jax.precision import data_type, require_precision
from dln_jax.types import InputError, Needs
from dln_jax.zoo.catalogue import CATALOGUE, assembled, entry_of
from dln_jax.zoo.parameter_files import REMEDY

Description = dict[str, Any]
"""Name, precision and keywords of a model, as JSON values."""
OWN = "own"
"""Name of a model without a stored factory."""


def describe(model: str | Callable[..., Any], *, precision: str, **keywords: Any) -> Description:
    """Describes a model by all keywords of its factory, with the defaults of keywords that you leave out.

    Args:
        model: a catalogue name; your own factory, which you pass again to load the model; or
            "package.module:function", which is imported and stored, so that `load(folder, trust=True)` finds it.
        precision: f32 or f64, the factory's `dtype`.
        keywords: keywords of the factory, in Python or as JSON (an activation or its name, `Needs` or a dictionary).

    Returns:
        JSON values, for `build` and `save`.

    Raises:
        InputError: an unknown name or keyword, a missing keyword, or a value that cannot be stored as JSON.

    Example:
        >>> import dln_jax
        >>> needs = dln_jax.Needs(joints=("revolute", "revolute"))
        >>> description = dln_jax.describe("structured-delan", precision="f32", needs=needs, width=16)
        >>> print(description["name"], description["width"], description["depth"])
        structured-delan 16 2
    """
    require_precision(precision)
    name = model if isinstance(model, str) else OWN
    functions = functions_of(name, None if isinstance(model, str) else model, trust=True)
    parameters = _parameters(functions)
    defaults = {key: field.default for key, field in parameters.items() if field.default is not field.empty}
    values = {key: _as_json(key, value) for key, value in (defaults | keywords).items()}
    _require_keys(values, parameters)
    return {"name": name, "precision": precision, **values}


def describe_for(
    name: str, data: Trajectories, needs: Needs, *, precision: str, pooled: bool = False, **keywords: Any
) -> Description:
    """Describes a model with the typical sizes of training data; errors as for `describe` and `typical_sizes`."""
    sizes = typical_sizes(name, data, pooled=pooled)
    return describe(name, precision=precision, **{"needs": needs, **keywords, **sizes})


def typical_sizes(name: str, data: Trajectories, *, pooled: bool = False) -> dict[str, float | list[float]]:
    """Returns the typical sizes that a model divides by: standard deviations of the data, to three digits.

    Args:
        pooled: one size for all coordinates, as a phase space needs, instead of one per coordinate. The data must then
            have all arrays; without `pooled`, a missing array leaves the factory's default.

    Raises:
        InputError: numbers so large or small that their squares overflow or vanish, or missing momenta.
    """
    sizes: dict[str, float | list[float]] = {}
    for keyword, keys in entry_of(name).sizes.items():
        arrays = [array for key in keys if (array := getattr(data, key)) is not None]
        if len(arrays) < len(keys):
            if pooled:
                raise InputError(
                    "the data have no momenta p and rates pd; add them, or set p = qd and pd = qdd (unit masses)"
                )
            continue
        numbers = np.concatenate(arrays)
        deviation = spread(" or ".join(keys), np.ravel(numbers)[:, None] if pooled else numbers)
        rounded = [float(f"{size:.3g}") if size > 0 else 1.0 for size in deviation]
        sizes[keyword] = rounded[0] if pooled else rounded
    return sizes


def build(description: Description, *, factory: Callable[..., Any] | None = None, trust: bool = False) -> Any:
    """Builds a model from its description.

    Equal descriptions of catalogue models return the same object, so its functions are traced once.

    Args:
        description: from `describe`.
        factory: your own factory, for a model outside the catalogue.
        trust: import the factory that the description names.

    Returns:
        A `Model`, or a model of functions or images: a pair of pure functions, such as `init` and `energies`.

    Raises:
        InputError: an unknown name; a keyword that is missing, unknown, of the wrong type or refused by the factory; or
            a factory outside the catalogue that is neither passed nor trusted.

    Example:
        >>> import dln_jax
        >>> needs = dln_jax.Needs(joints=("revolute",))
        >>> model = dln_jax.build(dln_jax.describe("trigonometric", precision="f32", needs=needs, degree=1))
        >>> print(repr(model).splitlines()[0])
        Model of 5 parameters
    """
    name = description.get("name")
    if not isinstance(name, str):
        raise InputError(f"model description: name is {reprlib.repr(name)}; expected a model name; {REMEDY}")
    if factory is None and name in CATALOGUE:
        with contextlib.suppress(TypeError):  # values that JSON cannot hold; _built refuses them
            return catalogued(json.dumps(description))
    return _built(description, functions_of(name, factory, trust=trust))


@functools.lru_cache(maxsize=16)
def catalogued(text: str) -> Any:
    """Builds the model of a JSON description, and caches it."""
    description = json.loads(text)
    return _built(description, functions_of(description["name"]))


def _built(description: Description, functions: tuple[Callable[..., Any], ...]) -> Any:
    values = {key: value for key, value in description.items() if key not in ("name", "precision")}
    expected = _parameters(functions)
    _require_keys(values, expected)
    if "precision" not in description:
        raise InputError(f"model description: lacks precision; {REMEDY}")
    if not isinstance(precision := description["precision"], str):
        raise InputError(f"precision is {reprlib.repr(precision)}; expected f32 or f64")
    keywords = {"dtype": data_type(precision), **_keywords(values, functions)}
    if "width" in keywords and "depth" in keywords:
        require_network(width=keywords["width"], depth=keywords["depth"])
    try:
        return assembled(functions, keywords)
    except InputError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"model description: {error}; a release that is newer or older may have written it") from error


def model_names() -> dict[str, str]:
    """Returns the name of every model in the catalogue, with the first line of its factory's docstring.

    Example:
        >>> import dln_jax
        >>> names = dln_jax.model_names()
        >>> print([name for name in names if name.endswith("delan")])
        ['structured-delan', 'black-box-delan']
    """
    return {name: (entry.factory.__doc__ or "").partition("\n")[0] for name, entry in CATALOGUE.items()}


def make(name: str, needs: Needs, *, precision: str = "f64", **keywords: Any) -> Any:
    """Makes a catalogue model for a plant; `print` shows its parameters.

    Args:
        name: one of `model_names()`.
        needs: joints and terms of the plant.
        precision: f32 or f64; f64 needs JAX's double precision.
        keywords: keywords of the factory, such as `width`.

    Returns:
        A `Model`, or a model of functions or images.

    Raises:
        InputError: as for `describe` and `build`.

    Example:
        >>> import jax
        >>> import dln_jax
        >>> needs = dln_jax.Needs(joints=("prismatic", "revolute"))
        >>> model = dln_jax.make("structured-delan", needs, precision="f32", width=8)
        >>> arm = dln_jax.dynamics(model.energies(model.init(jax.random.key(0))))
        >>> print(arm.mass_matrix([0.1, 0.5]).shape)
        (2, 2)
    """
    return build(describe(name, precision=precision, needs=needs, **keywords))


def functions_of(
    name: str, factory: Callable[..., Any] | None = None, *, trust: bool = False
) -> tuple[Callable[..., Any], ...]:
    """Returns the functions that make a named model: additions, then the factory. Errors as for `build`."""
    module, colon, function = name.partition(":")
    if not colon and name != OWN:
        entry = entry_of(name)
        if factory is not None:
            raise InputError(f"the model is a {name}, which has a factory; leave factory= out")
        return (*entry.additions, entry.factory)
    if factory is not None:
        return (factory,)
    if not colon:
        raise InputError("the file does not store the factory of this model; pass it as factory=")
    if not trust:
        raise InputError(
            f"the factory {name[:200]} is not part of dln_jax; "
            "pass that function as factory=, or trust=True to import it"
        )
    try:
        imported = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError, TypeError, ValueError) as error:
        raise InputError(f"{name[:200]} cannot be imported ({error}); expected package.module:function") from error
    if not callable(imported):
        raise InputError(f"{name[:200]} is not a function; expected a factory of models")
    return (imported,)


def _parameters(functions: tuple[Callable[..., Any], ...]) -> dict[str, inspect.Parameter]:
    variable = (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)
    return {
        key: parameter
        for function in reversed(functions)
        for key, parameter in inspect.signature(function).parameters.items()
        if key not in ("dtype", "make") and parameter.kind not in variable
    }


def _require_keys(values: Mapping[str, Any], expected: Collection[str]) -> None:
    """Raises `InputError` unless a description has exactly the expected keys."""
    if missing := set(expected) - set(values):
        raise InputError(f"model description: lacks {', '.join(sorted(missing))}; {REMEDY}")
    if unknown := set(values) - set(expected):
        raise InputError(f"model description: unknown keys {reprlib.repr(', '.join(sorted(unknown)))}; {REMEDY}")
    needs = values.get("needs")
    if isinstance(needs, dict) and (missing := set(Needs._fields) - set(needs)):
        raise InputError(f"model description: needs lack {', '.join(sorted(missing))}; {REMEDY}")


def _as_json(key: str, value: Any) -> Any:
    match value:
        case Activation():
            return value.name
        case Needs():
            return _as_json(key, value._asdict())
        case dict():
            return {name: _as_json(key, item) for name, item in value.items()}
        case list() | tuple():
            return [_as_json(key, item) for item in value]
        case float() if not math.isfinite(value):
            raise InputError(f"{key} is {value}; expected a finite number")
        case None | bool() | int() | float() | str():
            return value
    raise InputError(f"{key} is a {type(value).__name__}, which JSON cannot store; expected numbers, names or booleans")


def _keywords(values: Mapping[str, Any], functions: tuple[Callable[..., Any], ...]) -> dict[str, Any]:
    """Converts JSON values to the types in the signatures, with lists as tuples so that they are hashable.

    Raises:
        InputError: a value does not fit its annotation.
    """
    keywords: dict[str, Any] = {}
    for key, parameter in _parameters(functions).items():
        hint, value = parameter.annotation, values[key]
        if key == "needs":
            keywords[key] = needs_from_json(value)
        elif isinstance(parameter.default, Activation) or hint is Activation:
            keywords[key] = activation(as_type(value, str, name=f"model description: {key}", remedy=REMEDY))
        elif hint is parameter.empty or not _is_plain(hint):
            keywords[key] = _as_tuples(value)  # left to the factory
        else:
            keywords[key] = _as_tuples(as_type(value, hint, name=f"model description: {key}", remedy=REMEDY))
    return keywords


def _is_plain(hint: Any) -> bool:
    """Whether an annotation has JSON values only."""
    inner = get_args(hint)
    if get_origin(hint) is Literal or hint is Ellipsis:
        return True
    return all(map(_is_plain, inner)) if inner else hint in (bool, int, float, str, type(None), None, Any)


def _as_tuples(value: Any) -> Any:
    return tuple(map(_as_tuples, value)) if isinstance(value, list | tuple) else value
