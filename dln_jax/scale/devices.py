"""Describes the devices that JAX computes on: their kind, the cost of float64, and platforms that are unavailable."""

import statistics
import time

import jax
import jax.numpy as jnp

_ROWS = 2048
"""Size of the square matrices whose product is timed: 17 GFlop, enough to fill any device."""
_REPETITIONS = 5
_DEAR = 4.0
"""Cost of float64, relative to float32, from which a user is advised to consider float32."""


def unusable_platform() -> str | None:
    """Returns a message if JAX cannot start the platforms that the user asks for, else None."""
    wanted = getattr(jax.config, "jax_platforms")  # noqa: B009  JAX adds its settings as it starts
    try:
        jax.devices()
    except (RuntimeError, AssertionError):  # AssertionError: JAX knows the platform but has no library for it
        return (
            f"JAX cannot start '{wanted}' here, which JAX_PLATFORMS asks for; leave it unset for what there is, "
            "or install JAX for it (pip install 'jax[cuda12]' for NVIDIA)"
        )
    return None


def device_line() -> str:
    """Returns the number and kind of this process's devices, such as "1 gpu (NVIDIA H200)"."""
    devices = jax.local_devices()
    kinds = sorted({device.device_kind for device in devices})
    platform = devices[0].platform
    named = f" ({', '.join(kinds)})" if kinds != [platform] else ""
    return f"{len(devices)} {platform}{named}"


def double_precision_cost() -> float:
    """Measures the time of a float64 matrix product relative to float32, on the first device, in about a second.

    Typical values are 1 to 2 on CPUs and data-centre GPUs, and 32 or 64 on graphics cards.
    """
    seconds = {}
    with jax.enable_x64(True):
        for dtype in (jnp.float32, jnp.float64):
            square = jnp.ones((_ROWS, _ROWS), dtype) / _ROWS
            # "highest" keeps float32 from being computed in fewer bits on tensor cores.
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
    """Returns the lines that a training prints about its device; none on a CPU."""
    if jax.default_backend() == "cpu":
        return []
    advice = precision_advice(precision, double_precision_cost()) if precision == "f64" else None
    return [device_line(), *([advice] if advice else [])]


def precision_advice(precision: str, cost: float) -> str | None:
    """Returns advice on the precision ("f32", "f64") for this cost of float64, or None if there is none."""
    if precision != "f64" or cost < _DEAR:
        return None
    return (
        f"float64 takes {cost:.0f} times as long as float32 on this device: Gauss-Newton and references need it, "
        "networks by adam do not (--precision f32); a run may be faster on the processor (JAX_PLATFORMS=cpu)"
    )
