"""Describes the devices that JAX computes on: their kind, the cost of float64, and platforms that are unavailable."""

import statistics
import time

import jax
import jax.numpy as jnp

REPETITIONS = 5
EXPENSIVE = 4.0
"""Above this cost of float64, relative to float32, a user is advised to consider float32."""


def backend_started() -> bool:
    """Returns whether JAX has started a backend, which any array or list of devices does."""
    devices = getattr(jax.config, "jax_num_cpu_devices")  # noqa: B009  JAX adds its settings as it starts
    try:
        # JAX refuses another number of devices once a backend runs: the public way to learn whether one does.
        jax.config.update("jax_num_cpu_devices", devices + 2)
        jax.config.update("jax_num_cpu_devices", devices)
    except RuntimeError:
        return True
    return False


def unusable_platform() -> str | None:
    """Returns a message if JAX cannot start the platforms that the user asks for, else None."""
    requested = getattr(jax.config, "jax_platforms")  # noqa: B009  as above
    try:
        jax.devices()
    except (RuntimeError, AssertionError):  # AssertionError: JAX knows the platform but has no library for it
        return (
            f"JAX cannot start '{requested}' here, which JAX_PLATFORMS asks for; leave it unset for what there is, "
            "or install JAX for it (pip install 'jax[cuda12]' for NVIDIA)"
        )
    return None


def double_precision_cost(rows: int = 2048) -> float:
    """Measures the time of a float64 matrix product relative to float32, on the first device, in about a second.

    Typical values are 1 to 2 on CPUs and data-centre GPUs, and 32 or 64 on graphics cards.

    Args:
        rows: size of the square matrices; 2048 rows take 17 GFlop, enough to fill any device.
    """
    seconds = {}
    with jax.enable_x64(True):
        for dtype in (jnp.float32, jnp.float64):
            square = jnp.ones((rows, rows), dtype) / rows
            # "highest" keeps float32 from being computed in fewer bits on tensor cores.
            product = jax.jit(lambda x: jnp.matmul(x, x, precision="highest")).lower(square).compile()
            jax.block_until_ready(product(square))
            times = []
            for _ in range(REPETITIONS):
                began = time.perf_counter()
                jax.block_until_ready(product(square))
                times.append(time.perf_counter() - began)
            seconds[dtype] = statistics.median(times)
    return seconds[jnp.float64] / seconds[jnp.float32]


def device_lines(precision: str) -> list[str]:
    """Returns the lines that a training prints about its device, such as "1 gpu (NVIDIA H200)"; none on a CPU.

    Args:
        precision: "f32" or "f64"; float64 adds a line where it is much slower than float32.
    """
    if jax.default_backend() == "cpu":
        return []
    devices = jax.local_devices()
    kinds = sorted({device.device_kind for device in devices})
    platform = devices[0].platform
    lines = [f"{len(devices)} {platform}" + (f" ({', '.join(kinds)})" if kinds != [platform] else "")]
    if precision == "f64" and (cost := double_precision_cost()) >= EXPENSIVE:
        lines.append(
            f"float64 takes {cost:.0f} times as long as float32 on this device: Gauss-Newton and references need it, "
            "networks by adam do not (--precision f32); a run may be faster on the processor (JAX_PLATFORMS=cpu)"
        )
    return lines
