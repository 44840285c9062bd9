"""Single calls with the least time between question and answer, for a control loop.

By default JAX hands a computation on the CPU to another thread and returns at once, which costs a loop that waits for
the answer a change of threads each way. `enable_low_latency` computes in the calling thread instead; the setting is
read when the backend starts, and silently ignored afterwards, so that it is refused then. It serves single calls; large
batches, whose preparation overlaps with the computation, may be slower by it.

A jitted function with its parameters closed over is 1 to 2 us faster than what `lower().compile()` returns, whose call
passes through more Python; it is therefore what is used here.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dln_jax.mechanics.arguments import require_shape
from dln_jax.types import InputError

_SETTING = "jax_cpu_enable_async_dispatch"


def enable_low_latency() -> None:
    """Computes on the CPU in the calling thread from now on; the rest of the process included.

    Raises:
        InputError: a backend has started already (any array, or a list of devices, starts it), or JAX is to compute on
            something other than the CPU.
    """
    platforms = getattr(jax.config, "jax_platforms")  # noqa: B009  JAX adds its settings as it starts
    if platforms and platforms.split(",")[0] != "cpu":
        raise InputError(_only_on_cpu(platforms.split(",")[0]))
    if not jax.config.read(_SETTING):
        return
    devices = getattr(jax.config, "jax_num_cpu_devices")  # noqa: B009  JAX adds its settings as it starts
    try:
        # JAX refuses another number of devices once a backend runs: the public way to learn whether one does.
        jax.config.update("jax_num_cpu_devices", devices + 2)
        jax.config.update("jax_num_cpu_devices", devices)
    except RuntimeError as error:
        raise InputError(
            "enable_low_latency() was called after JAX had started its backend, which reads the setting when it "
            "starts; call it before the first array, right behind the imports"
        ) from error
    jax.config.update(_SETTING, False)


def low_latency(function: Callable[..., Any], *examples: Any, numpy: bool = False) -> Callable[..., Any]:
    """The function compiled for arguments like the examples, and called once.

    Args:
        function: of arrays, its parameters closed over, for instance `load(folder).dynamics.inverse_dynamics`.
        examples: one argument each, of the shape and type that calls will have.
        numpy: arguments are copied into one buffer, which costs one transfer instead of one for each, and results are
            NumPy arrays. Arguments must have one type; others are converted to it. The buffer makes the callable
            serve one thread at a time. By default arguments are NumPy or device arrays (device arrays are faster, 2 us
            for each argument) and results device arrays; another shape or type compiles anew.

    Raises:
        InputError: no examples, or with `numpy` ones of several types; a default device that is no CPU; from the
            callable with `numpy`, an argument of another shape than its example.
    """
    if (platform := jax.default_backend()) != "cpu":
        raise InputError(_only_on_cpu(platform))
    if not examples:
        raise InputError("low_latency got no example; give one argument of each kind that calls will have")
    if not numpy:
        compiled = jax.jit(function)
        # Each kind of array has its own short cut through the dispatch, which the first call makes.
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
    """The argument where it is an array of this shape, else such an array of the numbers that it holds.

    To be copied into the host's memory, where an assignment would broadcast silently.

    Raises:
        InputError: another shape, or nothing that is an array of numbers.
    """
    try:
        if argument.shape == shape and argument.dtype.kind in "fiu":
            return argument
    except AttributeError:
        pass
    try:
        array = np.asarray(argument)
    except (ValueError, TypeError):
        raise InputError(f"{name} makes no array; expected real numbers of shape {shape}") from None
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
    # A copy, also where JAX would hand back memory of its own or the buffer's.
    copied = np.array if single else partial(jax.tree.map, np.array)

    def evaluate(*arguments):
        if len(arguments) != len(views):
            raise InputError(f"{len(arguments)} arguments were given; expected {len(views)}, as in the examples")
        for (name, shape, view), argument in zip(views, arguments, strict=True):
            view[...] = as_shaped(name, argument, shape)
        return copied(compiled(buffer))

    evaluate(*arrays)
    return evaluate
