"""Samples of functions and their derivatives for regression: read from npz, or drawn from two textbook functions.

| key | shape | |
|---|---|---|
| `x` | [N, n] | inputs |
| `y` | [N, m] | values |
| `dy` | [N, m, n] | optional Jacobians dy/dx; [N, n] is accepted if m = 1 |
| `d2y` | [N, m, n, n] | optional Hessians d²y/dx²; [N, n, n] is accepted if m = 1 |

Units are the user's own.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dln_jax.data.arrays import load_file, numeric, unread_line
from dln_jax.data.splits import held_out
from dln_jax.types import InputError, require_positive

KEYS = ("x", "y", "dy", "d2y")


class FunctionSamples(NamedTuple):
    """Samples of one function of n inputs and m outputs, float64; shapes as in the module's table."""

    x: np.ndarray
    """[N, n]"""
    y: np.ndarray
    """[N, m]"""
    dy: np.ndarray | None = None
    """[N, m, n]"""
    d2y: np.ndarray | None = None
    """[N, m, n, n]"""

    @property
    def inputs(self) -> int:
        """n."""
        return self.x.shape[1]

    @property
    def outputs(self) -> int:
        """m."""
        return self.y.shape[1]


class SampleSplit(NamedTuple):
    """Disjoint samples for training and validation."""

    train: FunctionSamples
    validation: FunctionSamples


def load(path: str | Path) -> tuple[FunctionSamples, tuple[str, ...]]:
    """Reads and checks a file; also returns the keys that it skips. Never unpickles.

    Raises:
        InputError: the file is missing, is not an npz, holds pickled objects, or its arrays break the table above.
    """
    return load_file(path, lambda arrays: (from_arrays(arrays), unread_line(arrays)), KEYS)


def from_arrays(arrays: dict[str, Any]) -> FunctionSamples:
    """Checks arrays against the table above; an `InputError` names the key, its content and a remedy."""
    x, y = numeric(arrays, "x"), numeric(arrays, "y")
    for key, array, letter in (("x", x, "n"), ("y", y, "m")):
        if array.ndim != 2 or array.shape[1] == 0:
            remedy = f"a single column is {key}[:, None]" if array.ndim == 1 else "one row per sample"
            raise InputError(f"{key} has shape {array.shape}; expected [N, {letter}] with {letter} >= 1: {remedy}")
    if len(x) != len(y):
        raise InputError(
            f"y has {len(y)} samples, but x has {len(x)}; expected the same number: keep one row per sample"
        )
    if len(x) < 2:
        raise InputError(f"x has {len(x)} sample(s); expected at least 2: add samples")
    return FunctionSamples(x, y, _derivative(arrays, "dy", x, y, 1), _derivative(arrays, "d2y", x, y, 2))


def split(data: FunctionSamples, *, seed: int = 0) -> SampleSplit:
    """Draws a tenth of the samples, at least one, for validation.

    Raises:
        InputError: there are fewer than two samples.
    """
    samples = len(data.x)
    count = held_out(samples, 0.1, "samples")
    order = np.random.default_rng((seed, samples)).permutation(samples)

    def select(indices: np.ndarray) -> FunctionSamples:
        dy, d2y = (None if array is None else array[indices] for array in (data.dy, data.d2y))
        return FunctionSamples(data.x[indices], data.y[indices], dy, d2y)

    return SampleSplit(select(np.sort(order[count:])), select(np.sort(order[:count])))


def sine(x: np.ndarray) -> FunctionSamples:
    """sin x with exact derivatives, for x [N, 1]."""
    value, slope = np.sin(x), np.cos(x)
    return FunctionSamples(x, value, slope[:, :, None], -value[:, :, None, None])


def cosine_sine(x: np.ndarray) -> FunctionSamples:
    """cos x_1 sin x_2 with exact derivatives, for x [N, 2]."""
    (c1, s1), (c2, s2) = ((np.cos(column), np.sin(column)) for column in x.T)
    gradient = np.stack([-s1 * s2, c1 * c2], axis=-1)
    hessian = np.stack([np.stack([-c1 * s2, -s1 * c2], -1), np.stack([-s1 * c2, -c1 * s2], -1)], -1)
    return FunctionSamples(x, (c1 * s2)[:, None], gradient[:, None], hessian[:, None])


PUBLISHED: dict[str, tuple[Any, int, int]] = {"sin": (sine, 1, 100), "cos_sin": (cosine_sine, 2, 50)}
"""Functions of the published protocol: samples at x, number of inputs, and points of a grid per input."""


def published(
    name: str, *, samples: int = 25_600, noise: float = 1e-3, bound: float = np.pi, seed: int = 0
) -> FunctionSamples:
    """Draws samples of a function of `PUBLISHED` at x uniform in [-bound, bound], with Gaussian noise on all arrays.

    The published protocol has 25,600 samples, bound π, and noise with standard deviation 1e-3 on x, f and f'. The
    stored x is the noisy one, so even the true function leaves residuals. The published losses do not use the Hessian;
    it has the same noise.

    Raises:
        InputError: samples or bound are not positive, or the noise is negative.
    """
    require_positive(samples=samples, bound=bound)
    if not (0 <= noise < np.inf and bound < np.inf):
        raise InputError(f"noise is {noise} and the bound {bound}; expected finite numbers, the noise zero or positive")
    exact, inputs, _ = PUBLISHED[name]
    random = np.random.default_rng(seed)
    clean = exact(random.uniform(-bound, bound, (samples, inputs)))
    noisy = [array + noise * random.normal(size=array.shape) for array in clean]
    rows, columns = np.tril_indices(inputs)
    noisy[3][..., rows, columns] = noisy[3][..., columns, rows]  # a Hessian stays symmetric
    return FunctionSamples(*noisy)


def published_grid(name: str, *, bound: float = np.pi) -> FunctionSamples:
    """Evaluates a function of `PUBLISHED` on an even grid over [-bound, bound]; the first input is slowest."""
    exact, inputs, points = PUBLISHED[name]
    axes = [np.linspace(-bound, bound, points)] * inputs
    return exact(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, inputs))


def _derivative(arrays: dict[str, Any], key: str, x: np.ndarray, y: np.ndarray, order: int) -> np.ndarray | None:
    if key not in arrays:
        return None
    inputs, outputs = x.shape[1], y.shape[1]
    shape = (len(x), outputs, *(inputs,) * order)
    array = np.asarray(arrays[key])
    if outputs == 1 and array.shape == (len(x), *(inputs,) * order):
        array = array.reshape(shape)
    return numeric({**arrays, key: array}, key, shape, to_match=f"x {x.shape} and y {y.shape}")
