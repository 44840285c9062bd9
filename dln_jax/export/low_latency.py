"""Low-latency calls on the CPU, for control loops.

By default JAX hands a computation on the CPU to another thread and returns at once, so a loop that waits for the result
pays for two thread switches. `enable_low_latency` makes JAX compute in the calling thread. JAX reads the setting when
its backend starts and silently ignores it afterwards, so a late call is refused. Single calls become faster; large
batches, whose preparation overlaps with the computation, may become slower.

A jitted function with its parameters closed over is 1 to 2 us faster than the result of `lower().compile()`, whose call
passes through more Python; `low_latency` therefore returns a jitted function.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.mechanics.arguments import require_shape
from dln_jax.scale import backend_started
from dln_jax.types import InputError

_SETTING = "jax_cpu_enable_async_dispatch"


def enable_low_latency() -> None:
    """Makes JAX compute on the CPU in the calling thread, for the whole process from now on.

    Raises:
        InputError: a backend has already started (any array or list of devices starts it), or JAX is not on the CPU.
    """
    platforms = getattr(jax.config, "jax_platforms")  # noqa: B009  JAX adds its settings as it starts
    if platforms and platforms.split(",")[0] != "cpu":
        raise InputError(_only_on_cpu(platforms.split(",")[0]))
    if jax.config.read(_SETTING) and backend_started():
        raise InputError(
            "enable_low_latency() was called after JAX had started its backend, which reads the setting when it "
            "starts; call it before the first array, right behind the imports"
        )
    jax.config.update(_SETTING, False)


def low_latency(function: Callable[..., Any], *examples: Any, numpy: bool = False) -> Callable[..., Any]:
    """Compiles a function for arguments like the examples, calls it once, and returns it.

    Args:
        function: a function of arrays with its parameters closed over, such as
            `load(folder).dynamics.inverse_dynamics`.
        examples: one example per argument, with the shape and dtype of later calls.
        numpy: copy all arguments into one buffer, for a single transfer, and return NumPy arrays. Arguments are
            converted to one common dtype, and because of the buffer only one thread may call at a time. By default
            arguments are NumPy or device arrays (2 us faster), results device arrays; other shapes or dtypes recompile.

    Raises:
        InputError: there are no examples, `numpy` examples have several dtypes, or the default device is not a CPU;
            later calls with `numpy` raise it for an argument whose shape differs from its example.
    """
    if (platform := jax.default_backend()) != "cpu":
        raise InputError(_only_on_cpu(platform))
    if not examples:
        raise InputError("low_latency got no example; give one argument of each kind that calls will have")
    if not numpy:
        compiled = jax.jit(function)
        # JAX caches a fast dispatch path for NumPy and for device arrays, each at the first call with such arrays.
        for convert in (np.asarray, jnp.asarray):
            jax.block_until_ready(compiled(*map(convert, examples)))
        return compiled
    arrays = [np.asarray(example) for example in examples]
    types = {str(array.dtype) for array in arrays}
    if len(types) > 1:
        raise InputError(f"the examples have types {', '.join(sorted(types))}; give them one, or leave numpy=False")
    return _packed(function, arrays)


def _only_on_cpu(platform: str) -> str:
    return (
        f"low-latency mode is for the CPU, and JAX computes on {platform}: there every call waits for a launch and for "
        "copies both ways, whatever it computes; set JAX_PLATFORMS=cpu before JAX is imported, or export C (export_c)"
    )


def as_shaped(name: str, argument: Any, shape: tuple[int, ...]) -> Any:
    """Returns the argument as a real array of this shape, without a copy if it already is one.

    The check is needed because assignment to a buffer would broadcast silently.

    Raises:
        InputError: the argument has another shape, or is not an array of real numbers.
    """
    try:
        if argument.shape == shape and argument.dtype.kind in "fiu":
            return argument
    except AttributeError:
        pass
    try:
        array = np.asarray(argument)
    except (ValueError, TypeError):
        raise InputError(f"{name} is not an array; expected real numbers of shape {shape}") from None
    if array.dtype.kind not in "fiu":
        raise InputError(f"{name} has type {array.dtype}; expected real numbers of shape {shape}")
    require_shape(name, array.shape, shape)
    return array


def _packed(function: Callable[..., Any], arrays: list[np.ndarray]) -> Callable[..., Any]:
    buffer = np.concatenate([array.ravel() for array in arrays])
    ends, shapes = np.cumsum([array.size for array in arrays])[:-1], [array.shape for array in arrays]
    views = [
        (f"argument {number}", shape, piece.reshape(shape))
        for number, (shape, piece) in enumerate(zip(shapes, np.split(buffer, ends), strict=True), 1)
    ]

    @jax.jit
    def compiled(packed):
        return function(*map(jnp.reshape, jnp.split(packed, ends), shapes))

    single = isinstance(jax.eval_shape(compiled, jnp.asarray(buffer)), jax.ShapeDtypeStruct)
    # Results are copied, because JAX may return a view of its own memory or of the buffer.
    copied = np.array if single else partial(jax.tree.map, np.array)

    def evaluate(*arguments):
        if len(arguments) != len(views):
            raise InputError(f"got {len(arguments)} arguments; expected {len(views)}, as in the examples")
        for (name, shape, view), argument in zip(views, arguments, strict=True):
            view[...] = as_shaped(name, argument, shape)
        return copied(compiled(buffer))

    evaluate(*arrays)
    return evaluate
