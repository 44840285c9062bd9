"""Letters as smooth tip paths in the plane, for an arm that writes.

The outline of a glyph (DejaVu Sans, matplotlib's bundled font) is traced contour by contour:

1. each closed contour is resampled by arc length and smoothed by a Gaussian, which rounds the corners;
2. it is resampled more densely where it is curved, by the weight `(1 + (curvature bend_radius)²)^(1/4)`, blurred: with
   a constant rate of that phase the pen brakes ahead of bends. (Without the blur its centripetal acceleration would be
   at most `straight_speed² / bend_radius`.) People write like this: speed falls with a power of the curvature
   (Lacquaniti, Terzuolo and Viviani, 1983, "The law relating the kinematic and figural aspects of drawing movements");
3. a Fourier series in the phase replaces the samples: a contour is smooth everywhere and closes exactly;
4. the rate of the phase rises and falls as in a minimum-jerk motion (Flash and Hogan, 1985), for contours and for the
   straight pen-up moves between them. All are joined at rest: velocity and acceleration are continuous.

The shapes come from the font's own integer coordinates, so they do not depend on machine, rasteriser or settings.
"""

import math
from collections.abc import Callable
from pathlib import Path

import jax.numpy as jnp
import matplotlib
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, Float
from matplotlib.font_manager import FontProperties, get_font
from matplotlib.path import Path as Outline
from matplotlib.textpath import TextToPath

from dln_jax.types import InputError, Scalar

LETTERS = "abcdeghlmnopqrsuvwyz"
"""Letters of the embedded dataset `characters`."""

_SAMPLES = 4096
"""Number of points per contour for computing the Fourier series."""
_HARMONICS = 96
"""Highest harmonic of the series; its error is below a micrometre with the default smoothing."""


class _DesignUnits(TextToPath):
    """matplotlib's outlines at one pixel per font unit (1/2048 em), where coordinates are exact."""

    FONT_SCALE = 2048.0


def outline(character: str) -> list[Float[np.ndarray, "_ 2"]]:
    """Returns the outline of a glyph of DejaVu Sans as closed polygons, one [points, 2] per contour.

    Coordinates are in font units (1/2048 em), y up from the baseline; the last point repeats the first.

    Raises:
        InputError: `character` is not a single printable character with an outline.
    """
    expected = "expected one printable character with an outline in DejaVu Sans, such as 'a'"
    if not isinstance(character, str) or len(character) != 1:
        raise InputError(f"character is {character!r}, a {type(character).__name__}; {expected}")
    # A name would find a user's font of that name first.
    file = str(Path(matplotlib.get_data_path(), "fonts", "ttf", "DejaVuSans.ttf"))
    if not character.isprintable() or get_font(file).get_char_index(ord(character)) == 0:
        raise InputError(f"character is {character!r}, not in the font; {expected}")
    font = FontProperties(family="DejaVu Sans", fname=file)
    vertices, codes = _DesignUnits().get_text_path(font, character)
    # The font's points are integers; TrueType's implied points between them are multiples of one half.
    exact = np.round(2.0 * np.asarray(vertices, np.float64).reshape(-1, 2)) / 2.0
    outlines = Outline(exact, codes).to_polygons() if len(exact) > 0 else []
    # Single anchor points of a font draw nothing.
    polygons = [polygon for polygon in map(np.asarray, outlines) if np.ptp(polygon, axis=0).max() > 0.0]
    if not polygons:
        raise InputError(f"character is {character!r}, an empty glyph; {expected}")
    return polygons


def _contour(
    polygon: Float[np.ndarray, "points 2"],
    pen: Float[np.ndarray, "2"] | None,
    *,
    smoothing: float,
    bend_radius: float,
) -> tuple[Float[np.ndarray, "harmonics 2"], Float[np.ndarray, "harmonics 2"], float]:
    """Returns the smooth stroke along a closed polygon. It starts nearest to the pen (`None`: top left).

    Returns the coefficients of cos(2 pi k phase) and sin(2 pi k phase), k = 0, 1, .., and the length in m.
    """
    corners = polygon @ np.array([1.0, 1.0j])
    arc = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(corners)))])
    uniform = np.arange(_SAMPLES) / _SAMPLES
    wave_number = 2.0 * np.pi * np.fft.fftfreq(_SAMPLES, 1.0 / _SAMPLES)
    blur = np.exp(-0.5 * (wave_number * smoothing / arc[-1]) ** 2)
    spectrum = np.fft.fft(np.interp(uniform * arc[-1], arc, corners)) * blur
    curve = np.fft.ifft(spectrum)
    first = np.fft.ifft(1j * wave_number * spectrum)
    second = np.fft.ifft(-(wave_number**2) * spectrum)
    stretch = np.abs(first)
    curvature = np.imag(np.conj(first) * second) / stretch**3
    weight = stretch * (1.0 + (curvature * bend_radius) ** 2) ** 0.25
    # The blur makes the pen brake ahead of a bend.
    weight = np.fft.ifft(np.fft.fft(weight) * blur).real
    top_left = np.argmax(curve.imag - 0.5 * curve.real)
    start = top_left if pen is None else np.argmin(np.abs(curve - pen @ np.array([1.0, 1.0j])))
    curve, weight = np.roll(curve, -start), np.roll(weight, -start)
    curve, weight = np.append(curve, curve[0]), np.append(weight, weight[0])
    phase = np.concatenate([[0.0], np.cumsum(0.5 * (weight[1:] + weight[:-1]))])
    by_phase = np.interp(uniform * phase[-1], phase, curve)
    both = np.stack([by_phase.real, by_phase.imag], axis=-1)
    series = np.fft.rfft(both, axis=0)[: _HARMONICS + 1] * (2.0 / _SAMPLES)
    series[0] *= 0.5
    return series.real, -series.imag, float(np.abs(np.diff(curve)).sum())


def _minimum_jerk_phase(time: Scalar, ramp: Scalar) -> Scalar:
    """Phase 0..1 at relative time 0..1: its rate rises during `ramp`, stays constant, and falls during `ramp`."""
    # The second half mirrors the first.
    early = jnp.where(time > 0.5, 1.0 - time, time)
    rising = jnp.where(early < ramp, early, ramp) / ramp
    # Integral of the minimum-jerk step 10 s³ - 15 s⁴ + 6 s⁵.
    risen = ramp * rising**4 * (2.5 + rising * (rising - 3.0))
    phase = jnp.where(early < ramp, risen, early - 0.5 * ramp) / (1.0 - ramp)
    return jnp.where(time > 0.5, 1.0 - phase, phase)


def _position(
    duration: Float[Array, ""],
    starts: Float[Array, "strokes"],
    shares: Float[Array, "strokes"],
    ramps: Float[Array, "strokes"],
    cosines: Float[Array, "strokes harmonics 2"],
    sines: Float[Array, "strokes harmonics 2"],
    displacements: Float[Array, "strokes 2"],
    time: Scalar,
) -> Float[Array, "2"]:
    """Returns the tip at this time; `starts` and `shares` of the strokes are relative to the duration.

    `ramps` are the fractions of a stroke's time for speeding up, and for slowing down, at most 1/2.
    """
    relative = jnp.clip(time / duration, 0.0, 1.0)
    stroke = jnp.sum(relative >= starts[1:])
    local = (relative - starts[stroke]) / shares[stroke]
    phase = _minimum_jerk_phase(local, ramps[stroke])
    angles = 2.0 * jnp.pi * phase * jnp.arange(cosines.shape[1])
    periodic = jnp.cos(angles) @ cosines[stroke] + jnp.sin(angles) @ sines[stroke]
    return periodic + phase * displacements[stroke]


def require_finite(**numbers: int | float) -> None:
    """Raises `InputError` that names the first number that is not positive and finite."""
    for name, value in numbers.items():
        if not 0 < value < math.inf:
            raise InputError(f"{name} is {value!r}; expected a finite number above 0")


def letter_path(
    character: str,
    *,
    height: float = 0.55,
    centre: tuple[float, float] = (1.05, 0.45),
    mean_speed: float = 0.53,
    smoothing: float = 0.04,
    bend_radius: float = 0.3,
    ramp_length: float = 0.2,
) -> tuple[float, Callable[[Scalar], Float[Array, "2"]]]:
    """Returns the tip's motion along the outline of a character; the module docstring describes the steps.

    Returns the duration in s, from rest to rest, and a function: time in s -> tip (x, y) in m. `jax.jvp` gives the
    velocity, and applied twice the acceleration. The function is a pytree. If a jitted function takes it as an
    argument, all letters with the same number of strokes share one compilation. It is constant before and after the
    motion and computes in JAX's default float.

    Args:
        character: one printable character with an outline in DejaVu Sans.
        height: height of a lower-case x, m; characters share this scale and keep the font's proportions.
        centre: (x, y) in m of the point midway across the character and half an x-height above the baseline.
        mean_speed: length of the path divided by its duration, m/s; it only scales time.
        smoothing: standard deviation of the Gaussian along the contour, m; corners are rounded by about this.
        bend_radius: the pen slows down in bends of a smaller radius, m.
        ramp_length: cost of one start and one stop as an equivalent distance at full speed, m.

    Raises:
        InputError: the character has no outline, or a number is not finite or not positive.
    """
    polygons = outline(character)
    require_finite(height=height, mean_speed=mean_speed, smoothing=smoothing)
    require_finite(bend_radius=bend_radius, ramp_length=ramp_length)
    if np.shape(centre) != (2,) or not np.all(np.isfinite(centre)):
        raise InputError(f"centre is {centre!r}; expected two finite numbers (x, y) in m")

    widths = np.concatenate(polygons)[:, 0]
    x_height = outline("x")[0][:, 1].max()
    middle = 0.5 * np.array([widths.min() + widths.max(), x_height])
    strokes, pen = [], None
    for polygon in polygons:
        placed = (polygon - middle) * (height / x_height) + np.asarray(centre)
        cosines, sines, length = _contour(placed, pen, smoothing=smoothing, bend_radius=bend_radius)
        start = cosines.sum(axis=0)
        if pen is not None:  # a straight pen-up move is a displacement without harmonics
            at_pen = np.zeros_like(cosines)
            at_pen[0] = pen
            strokes.append((at_pen, np.zeros_like(sines), start - pen, float(np.hypot(*(start - pen)))))
        strokes.append((cosines, sines, np.zeros(2), length))
        pen = start

    cosines, sines, displacements, lengths = map(np.stack, zip(*strokes, strict=True))
    duration = float(lengths.sum() / mean_speed)
    costs = lengths + ramp_length
    shares = costs / costs.sum()
    times = duration, np.cumsum(shares) - shares, shares, np.minimum(ramp_length / costs, 0.5)
    return duration, Partial(_position, *map(jnp.asarray, (*times, cosines, sines, displacements)))
