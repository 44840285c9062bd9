"""Low-latency calls on the CPU, for control loops.

By default JAX passes a CPU computation to another thread and returns at once, so a loop that waits for the result pays
for two thread switches. `enable_low_latency` makes JAX compute in the calling thread. JAX reads the setting when its
backend starts and silently ignores it afterwards, so a late call is refused. Single calls become faster. Large batches
may become slower, because preparation no longer overlaps with computation.

A call of a jitted function with its parameters closed over is 1 to 2 us faster than a call of `lower().compile()`,
which runs more Python. So `low_latency` returns a jitted function.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.scale import backend_started
from dln_jax.types import InputError

_SETTING = "jax_cpu_enable_async_dispatch"


def enable_low_latency() -> None:
    """Makes JAX compute on the CPU in the calling thread, for the whole process from now on.

    A call of a small function then takes a few microseconds less. Call it before the first array.

    Raises:
        InputError: a backend has already started (any array or list of devices starts it), or JAX is not on the CPU.

    Example:
        >>> import dln_jax
        >>> dln_jax.enable_low_latency()  # right behind the imports
    """
    platforms = getattr(jax.config, "jax_platforms")  # noqa: B009  JAX adds its settings as it starts
    if (first := (platforms or "cpu").split(",")[0]) != "cpu":
        raise InputError(_only_on_cpu(first))
    if jax.config.read(_SETTING) and backend_started():
        raise InputError(
            "JAX has already started its backend and reads this setting only at the start; call enable_low_latency() "
            "before the first array, right behind the imports"
        )
    jax.config.update(_SETTING, False)


def low_latency(function: Callable[..., Any], *examples: Any) -> Callable[..., Any]:
    """Compiles a function for arguments like the examples, calls it once, and returns it.

    Arguments are NumPy or device arrays, results device arrays. Arguments of other shapes or types compile it again.

    Args:
        function: a function of arrays with its parameters closed over, such as
            `load(folder).dynamics.inverse_dynamics`.
        examples: one example per argument, with the shape and dtype of later calls.

    Raises:
        InputError: there are no examples, or the default device is not a CPU.

    Example:
        >>> import numpy as np
        >>> import dln_jax
        >>> cart = dln_jax.dynamics(dln_jax.LagrangianSystem(lambda q, qd: 1.5 * qd @ qd))
        >>> torque = dln_jax.low_latency(cart.inverse_dynamics, *np.ones((3, 1)))
        >>> print(torque(np.zeros(1), np.zeros(1), np.array([2.0])))
        [6.]
    """
    if (platform := jax.default_backend()) != "cpu":
        raise InputError(_only_on_cpu(platform))
    if not examples:
        raise InputError("low_latency got no example; pass one example for each argument")
    compiled = jax.jit(function)
    # JAX caches a fast dispatch path for NumPy and for device arrays, each at the first call with such arrays.
    for convert in (np.asarray, jnp.asarray):
        jax.block_until_ready(compiled(*map(convert, examples)))
    return compiled


def _only_on_cpu(platform: str) -> str:
    return (
        f"low-latency mode is for the CPU, but JAX computes on {platform}, where every call waits for a launch and for "
        "copies both ways; set JAX_PLATFORMS=cpu before importing JAX, or export C (export_c)"
    )
