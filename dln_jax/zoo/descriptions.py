"""What a model's file says of it: JSON values that build the same model again, whatever becomes of defaults.

A description has `name`, `precision` (f32 or f64), and every keyword that the signature of the name's factory has
(`dtype` apart, which the precision stands for). Names are those of the catalogue; "package.module:function" for a
factory of one's own that can be imported; and "own" for one that whoever loads the model gives.
"""

import importlib
import inspect
import math
import reprlib
from collections.abc import Callable, Mapping, Sequence
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin

import numpy as np

from dln_jax.data.magnitudes import spread
from dln_jax.data.schema import Trajectories
from dln_jax.data.stated_needs import needs_from_json
from dln_jax.files import matches
from dln_jax.nn.activations import Activation, activation
from dln_jax.precision import data_type, require_precision
from dln_jax.sizes import require_network
from dln_jax.types import InputError, Needs
from dln_jax.zoo.catalogue import entry_of
from dln_jax.zoo.parameter_files import REMEDY

Description = dict[str, Any]
"""JSON values."""
STATED = set(Needs._fields) - {"joint_friction", "joint_map", "velocity_scale"}
"""What needs in a file state; older ones say nothing of the friction of joints, since there was none."""
OWN = "own"
"""Name of a model whose factory the file does not tell."""


def describe(model: str | Callable[..., Any], *, precision: str, **keywords: Any) -> Description:
    """The description of a model, with every keyword of its factory: those given, and the defaults of the others.

    Args:
        model: a name of the catalogue; a factory of one's own, which has to be given again to load the model; or
            "package.module:function", which is imported, and stored, so that `load(folder, trust=True)` finds it.
        precision: f32 or f64, the factory's `dtype`.
        keywords: of the factory, in Python or as JSON (an activation or its name, `Needs` or their dictionary).

    Raises:
        InputError: an unknown name or keyword, one that is missing, or a value that no file can hold.
    """
    require_precision(precision)
    name = model if isinstance(model, str) else OWN
    factory = factory_of(name, None if isinstance(model, str) else model, trust=True)
    parameters = _parameters(factory)
    values = {key: each.default for key, each in parameters.items() if each.default is not each.empty} | keywords
    description = {"name": name, "precision": precision, **{key: _as_json(key, each) for key, each in values.items()}}
    require_complete(description, factory)
    return description


def describe_for(
    name: str, data: Trajectories, needs: Needs, *, precision: str, pooled: bool = False, **keywords: Any
) -> Description:
    """The description of a model of the catalogue for these training data, whose typical sizes are theirs.

    Raises:
        InputError: as `describe` and `typical_sizes`.
    """
    sizes = typical_sizes(name, data, pooled=pooled)
    return describe(name, precision=precision, **{"needs": needs, **keywords, **sizes})


def typical_sizes(name: str, data: Trajectories, *, pooled: bool = False) -> dict[str, float | list[float]]:
    """The typical sizes that a model divides by, to three digits: standard deviations of the data.

    Args:
        name: of the catalogue.
        data: for training.
        pooled: one size for all coordinates, which a phase space needs, in place of one each; the data must then have
            what it is taken from. Otherwise what they lack leaves the factory's default.

    Raises:
        InputError: numbers so large or small that their squares are infinite or zero, or momenta that are missing.
    """
    sizes: dict[str, float | list[float]] = {}
    for keyword, keys in entry_of(name).sizes.items():
        arrays = [array for key in keys if (array := getattr(data, key)) is not None]
        if len(arrays) < len(keys):
            if pooled:
                raise InputError(
                    "the data have no momenta p and their rates pd; add them, or set p = qd per unit of mass"
                )
            continue
        numbers = np.concatenate(arrays)
        deviation = spread(" or ".join(keys), np.ravel(numbers)[:, None] if pooled else numbers)
        rounded = [float(f"{size:.3g}") if size > 0 else 1.0 for size in deviation]
        sizes[keyword] = rounded[0] if pooled else rounded
    return sizes


def build(description: Description, *, factory: Callable[..., Any] | None = None, trust: bool = False) -> Any:
    """The model that a description stands for: a `Model`, or one of functions or pictures.

    Args:
        description: as `describe` gives it.
        factory: of one's own, for a model that is not of the catalogue.
        trust: import the factory that the description names.

    Raises:
        InputError: an unknown name, a keyword that is missing, unknown or of another type, or one that the factory
            refuses; or a factory of one's own that was neither given nor trusted.
    """
    name = description.get("name")
    if not isinstance(name, str):
        raise InputError(f"model description: name is {reprlib.repr(name)}, expected that of a model; {REMEDY}")
    make = factory_of(name, factory, trust=trust)
    require_complete(description, make)
    if not matches(description["precision"], str):
        raise InputError(f"precision is {reprlib.repr(description['precision'])}; expected f32 or f64")
    dtype = data_type(description["precision"])
    keywords = {
        key: _from_json(key, description[key], each) for key, each in _parameters(make).items() if key in description
    }
    if "width" in keywords and "depth" in keywords:
        require_network(width=keywords["width"], depth=keywords["depth"])
    if "dtype" in inspect.signature(make).parameters:
        keywords["dtype"] = dtype
    try:
        return make(**keywords)
    except InputError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"model description: {error}; a release that is newer or older may have written it") from error


def factory_of(name: str, given: Callable[..., Any] | None = None, *, trust: bool = False) -> Callable[..., Any]:
    """The factory of a name: the catalogue's, the given one, or, trusted, an imported one; arguments as `build`.

    Raises:
        InputError: as `build`.
    """
    module, colon, function = name.partition(":")
    if not colon and name != OWN:
        entry = entry_of(name)
        if given is not None:
            raise InputError(f"the model is a {name}, which has a factory; leave factory= out")
        return entry.factory
    if given is not None:
        return given
    if not colon:
        raise InputError("the model has a factory of its own, which the file does not tell; give it as factory=")
    if not trust:
        raise InputError(
            f"the model is made by {name[:200]}, which is no code of this package; "
            "give that function as factory=, or trust=True to have it imported"
        )
    try:
        found = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError, TypeError, ValueError) as error:
        raise InputError(f"{name[:200]} cannot be imported ({error}); expected package.module:function") from error
    if not callable(found):
        raise InputError(f"{name[:200]} is no function; expected a factory of models")
    return found


def _parameters(factory: Callable[..., Any]) -> Mapping[str, inspect.Parameter]:
    """What a description has of a factory."""
    every = inspect.signature(factory).parameters
    variable = (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)
    return {key: each for key, each in every.items() if key != "dtype" and each.kind not in variable}


def require_complete(description: Description, factory: Callable[..., Any]) -> None:
    """Raises `InputError` unless a description has every key that it should, and no other."""
    expected = {"name", "precision", *_parameters(factory)}
    if missing := expected - set(description):
        raise InputError(f"model description: lacks {', '.join(sorted(missing))}; {REMEDY}")
    if unknown := set(description) - expected:
        raise InputError(f"model description: unknown are {reprlib.repr(', '.join(sorted(unknown)))}; {REMEDY}")
    needs = description.get("needs")
    if isinstance(needs, dict) and "needs" in expected and (missing := STATED - set(needs)):
        raise InputError(f"model description: needs lack {', '.join(sorted(missing))}; {REMEDY}")


def _as_json(key: str, value: Any) -> Any:
    match value:
        case Activation():
            return value.name
        case Needs():
            return _as_json(key, value._asdict())
        case dict():
            return {name: _as_json(key, each) for name, each in value.items()}
        case list() | tuple():
            return [_as_json(key, each) for each in value]
        case float() if not math.isfinite(value):
            raise InputError(f"{key} is {value}; expected a finite number")
        case None | bool() | int() | float() | str():
            return value
    raise InputError(f"{key} is a {type(value).__name__}, which no file can hold; expected numbers, names or switches")


def _from_json(key: str, value: Any, parameter: inspect.Parameter) -> Any:
    """A keyword of a factory, hashable where it can be.

    Raises:
        InputError: it is not what the factory takes.
    """
    if key == "needs":
        return needs_from_json(value)
    hint = parameter.annotation
    named = hint is Activation or isinstance(parameter.default, Activation)
    if not _fits(value, str if named else hint):
        wanted = "the name of an activation" if named else _words(hint)
        raise InputError(f"model description: {key} is {reprlib.repr(value)}, expected {wanted}; {REMEDY}")
    return activation(value) if named else _as_tuples(value)


def _as_tuples(value: Any) -> Any:
    return tuple(map(_as_tuples, value)) if isinstance(value, list | tuple) else value


def _fits(value: Any, hint: Any) -> bool:
    """Whether a JSON value may be one of a factory's annotation; what says nothing here is left to the factory."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return any(_fits(value, each) for each in inner)
    if origin in (tuple, list, Sequence):
        return isinstance(value, list | tuple) and all(_fits(each, inner[0]) for each in value)
    if origin is Callable:
        return False
    if origin is Literal or hint in (bool, int, float, str, type(None), None):
        return matches(value, hint)
    return True


def _words(hint: Any) -> str:
    return hint.__name__ if isinstance(hint, type) else str(hint)
