"""The devices that JAX computes on: which they are, what float64 costs there, and a platform that cannot be had."""

import statistics
import time

import jax
import jax.numpy as jnp

_ROWS = 2048
"""Of the matrices whose product is timed: 17 GFlop, which fills any device."""
_REPETITIONS = 5
_DEAR = 4.0
"""From this cost of float64 on, in units of float32, a user is told what it is needed for."""


def unusable_platform() -> str | None:
    """What is wrong with the platforms that a user asks JAX for, if they cannot be had here."""
    wanted = getattr(jax.config, "jax_platforms")  # noqa: B009  JAX adds its settings as it starts
    try:
        jax.devices()
    except (RuntimeError, AssertionError):  # of a platform that JAX knows and has no library for, the latter
        return (
            f"JAX cannot start '{wanted}' here, which JAX_PLATFORMS asks for; leave it unset for what there is, "
            "or install JAX for it (pip install 'jax[cuda12]' for NVIDIA)"
        )
    return None


def device_line() -> str:
    """How many devices of which kind this process computes on, such as "1 gpu (NVIDIA H200)"."""
    devices = jax.local_devices()
    kinds = sorted({device.device_kind for device in devices})
    platform = devices[0].platform
    named = f" ({', '.join(kinds)})" if kinds != [platform] else ""
    return f"{len(devices)} {platform}{named}"


def double_precision_cost() -> float:
    """Seconds of a matrix product in float64 over those in float32, on the first device.

    1 to 2 on processors and on GPUs for computing centres; 32 or 64 on those for graphics. Takes about a second.
    """
    seconds = {}
    with jax.enable_x64(True):
        for dtype in (jnp.float32, jnp.float64):
            square = jnp.ones((_ROWS, _ROWS), dtype) / _ROWS
            # float32 as the library computes it, and not in fewer bits on units for that.
            product = jax.jit(lambda x: jnp.matmul(x, x, precision="highest")).lower(square).compile()
            jax.block_until_ready(product(square))
            times = []
            for _ in range(_REPETITIONS):
                began = time.perf_counter()
                jax.block_until_ready(product(square))
                times.append(time.perf_counter() - began)
            seconds[dtype] = statistics.median(times)
    return seconds[jnp.float64] / seconds[jnp.float32]


def device_lines(precision: str) -> list[str]:
    """What a training in a precision should say of the device; nothing on a CPU."""
    if jax.default_backend() == "cpu":
        return []
    advice = precision_advice(precision, double_precision_cost()) if precision == "f64" else None
    return [device_line(), *([advice] if advice else [])]


def precision_advice(precision: str, cost: float) -> str | None:
    """What a user should know who computes in a precision ("f32", "f64") where float64 has such a cost."""
    if precision != "f64" or cost < _DEAR:
        return None
    return (
        f"float64 takes {cost:.0f} times as long as float32 on this device: Gauss-Newton and references need it, "
        "networks by adam do not (--precision f32); a run may be faster on the processor (JAX_PLATFORMS=cpu)"
    )
