"""Dynamics from energies: write or learn a scalar energy, get equations of motion, rollouts and controllers.

`dln_jax` exports the most common names; import any other from the module that defines it. Functions take one state
(`q, qd, qdd, tau` of shape [d], SI units); `jax.vmap` maps them over samples.
"""

import importlib
import importlib.metadata
from typing import TYPE_CHECKING, Any

import dln_jax.process  # noqa: F401  first, so that Ctrl-C during the imports prints one word

if TYPE_CHECKING:
    from dln_jax.public import *  # noqa: F403


def __getattr__(name: str) -> Any:
    """Imports the public names on first use, so that the help of a command does not wait for JAX."""
    if name == "__version__":
        return importlib.metadata.version("dln-jax")
    if name.startswith("__") and name != "__all__":
        raise AttributeError(f"module 'dln_jax' has no attribute {name!r}")
    public = importlib.import_module("dln_jax.public")
    if name == "__all__":
        return [*public.__all__, "__version__"]
    if name in public.__all__:
        return getattr(public, name)
    if name in globals():  # a subpackage, which the import above has loaded
        return globals()[name]
    raise AttributeError(f"module 'dln_jax' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__getattr__("__all__")})
