"""Common style of all figures: width, text sizes, a light grid, and one colour per model; and films.

Matplotlib's global state is neither read nor set: figures are made without pyplot, and settings that Matplotlib would
apply later, when it makes ticks, are set on every axis.
"""

import io
import shutil
import subprocess
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from PIL import Image

from dln_jax.data.schema import Trajectories
from dln_jax.files import write_bytes, writing

WIDTH, DPI = 7.2, 150
"""Inches, and pixels per inch: 1,080 pixels, the width of a page."""
TEXT, SMALL = 9.0, 8.0
"""Text sizes in points."""
TRUTH = "truth"
REFERENCE = "0.55"
"""Colour of published and other reference values."""

BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9"
CYCLE = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY, "#555555", "#882255")
"""Colours for everything but models (Okabe and Ito 2008, safe for colour-blind readers)."""
MARKERS = "osv^Ddp*"

MODELS: dict[str, str] = {
    "structured-delan": BLUE,
    "black-box-delan": SKY,
    "structured-hnn": VERMILLION,
    "black-box-hnn": ORANGE,
    "trigonometric": GREEN,
    "learned-tree": "#117733",
    "planar-chain": GREEN,
    "rigid-tree": GREEN,
    "feed-forward": PURPLE,
    "separable-hnn": "#B2182B",
    "pairwise-hnn": "#882255",
    "polynomial-hamiltonian": "#44AA99",
    "helmholtz-hnn": "#AA4499",
    "phase-network": "#7E57A6",
    "differential-network": "#332288",
    TRUTH: "black",
}
"""Colours of models: Lagrangians are blue, Hamiltonians warm, linear models and trees green, others purple."""
UNKNOWN = "#555555"
FILM_DPI, COLOURS = 100, 128
"""Pixels per inch, and number of colours, of a GIF."""


def colour(name: str) -> str:
    """Returns the colour of a model or of its variant "MODEL-..."; grey for an unknown name."""
    models = [model for model in MODELS if f"{name}-".startswith(f"{model}-")]
    return MODELS[max(models, key=len)] if models else UNKNOWN


def figure(
    rows: int = 1, columns: int = 1, *, height: float, width: float = WIDTH, dpi: int = DPI, **options
) -> tuple[Figure, np.ndarray]:
    """Returns a figure and its axes [rows, columns] for Agg; sizes in inches, `options` as for `Figure.subplots`."""
    drawn = blank(height=height, width=width, dpi=dpi)
    axes = drawn.subplots(rows, columns, squeeze=False, **options)
    prepare(*axes.flat)
    return drawn, axes


def blank(*, height: float, width: float = WIDTH, dpi: int = DPI) -> Figure:
    """Returns a figure without axes."""
    drawn = Figure(figsize=(width, height), layout="constrained", dpi=dpi)
    FigureCanvasAgg(drawn)
    return drawn


def prepare(*axes: Axes) -> None:
    """Sets text sizes and the grid of axes that were added to a figure."""
    for axis in axes:
        axis.tick_params(which="both", labelsize=SMALL)
        for side in (axis.xaxis, axis.yaxis):
            side.label.set_fontsize(TEXT)
            side.get_offset_text().set_fontsize(SMALL)
        axis.spines[["top", "right"]].set_visible(False)
        axis.spines[["bottom", "left"]].set_color("0.4")
        axis.grid(True, which="major", color="0.9", linewidth=0.7)
        axis.set_axisbelow(True)


def title(axis: Axes, text: str, **options) -> None:
    """Sets a title with an explicit text size, which `set_title` would take from Matplotlib's settings."""
    axis.set_title(text, **{"fontsize": TEXT, **options})


def legend(of: Axes | Figure, *args, **options) -> Legend:
    """Adds a legend without a frame, in small text."""
    return of.legend(*args, **{"frameon": False, "fontsize": SMALL, **options})


def legend_beside(figure: Figure, axis: Axes, *, columns: int, place: str = "outside lower center") -> None:
    """Adds the legend of one of a figure's axes beside them, by default below."""
    handles, labels = axis.get_legend_handles_labels()
    legend(figure, handles, labels, loc=place, ncols=min(columns, len(labels)))


def separate(axis: Axes, places: Iterable[float]) -> None:
    """Draws thin vertical lines between motions."""
    for place in places:
        axis.axvline(place, color="0.75", linewidth=0.8, zorder=0)


def scale_of(values: Iterable[float | int]) -> str:
    """Returns "log" for positive values that span a decade or more, else "linear"."""
    numbers = np.asarray(list(values), float)
    numbers = numbers[np.isfinite(numbers)]
    return "log" if len(numbers) and numbers.min() > 0 and numbers.max() >= 10 * numbers.min() else "linear"


def prefixed(size: float | int, unit: str) -> tuple[float, str]:
    """Returns the scale factor and the prefixed unit that suit values of this size: (1e-6, "µN m") for 3e-5 N m."""
    prefixes = {1e6: "M", 1e3: "k", 1.0: "", 1e-3: "m", 1e-6: "µ", 1e-9: "n", 1e-12: "p", 1e-15: "f"}
    factor = next((factor for factor in prefixes if size >= factor), 1.0 if size == 0 else 1e-15)
    return factor, f"{prefixes[factor]}{unit}"


def colours_of(names: Iterable[str]) -> dict[str, str]:
    """Assigns colours in sequence, for everything except models."""
    return {name: CYCLE[number % len(CYCLE)] for number, name in enumerate(names)}


def unit_of(data: Trajectories, joint: int, key: Literal["q", "qd", "tau"] = "tau") -> str:
    """Returns the unit of a joint's position, velocity or force; joints of unknown kind count as revolute."""
    prismatic = data.needs is not None and data.needs.joints[joint] == "prismatic"
    return {"q": ("rad", "m"), "qd": ("rad/s", "m/s"), "tau": ("N m", "N")}[key][prismatic]


def with_unit(name: str, unit: str) -> str:
    """Returns the axis label of a quantity, with its unit if it has one."""
    return f"{name}, {unit}" if unit else name


def write_gif(
    path: Path,
    figure: Figure,
    show: Callable[[int], None],
    t: Float[np.ndarray, " times"] | None,
    *,
    frames: Iterable[int],
    frames_per_second: float,
    title: str = "",
) -> None:
    """Writes a GIF by calling `show(frame)` for every frame, with the title and, unless t is `None`, the time in s.

    If `ffmpeg` is installed, an MP4 of the same name is written beside it.

    Raises:
        InputError: the file cannot be written. It is written completely or not at all.
    """
    heading = figure.suptitle("", fontsize=TEXT, family="monospace")
    figure.set_dpi(FILM_DPI)
    canvas, images = FigureCanvasAgg(figure), []
    for frame in frames:
        show(frame)
        heading.set_text(title if t is None else f"{title}  t = {t[frame]:5.2f} s".strip())
        canvas.draw()
        images.append(Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3]).quantize(dither=Image.Dither.NONE))
        # Fix the axes at the positions of the first frame.
        figure.set_layout_engine("none")
    # One palette for all frames and no dithering make the file a third smaller.
    some = [image.convert("RGB") for image in images[:: max(1, len(images) // 6)]]
    palette = Image.fromarray(np.concatenate([np.asarray(image) for image in some])).quantize(COLOURS)
    entries = np.reshape(palette.getpalette(), (-1, 3))
    entries[entries.sum(axis=1) >= 735] = 255  # the background is white
    palette.putpalette(entries.ravel().tolist())
    images = [image.convert("RGB").quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    content, duration = io.BytesIO(), round(1000 / frames_per_second)
    images[0].save(content, "gif", save_all=True, append_images=images[1:], duration=duration, loop=0, optimize=True)
    write_bytes(path, content.getvalue())
    if ffmpeg := shutil.which("ffmpeg"):
        # Players expect even sizes and this format of pixels. If ffmpeg fails, it says so, and there is no MP4.
        options = "-y -v error -r {} -i - -vf pad=ceil(iw/2)*2:ceil(ih/2)*2:color=white -pix_fmt yuv420p -f mp4"
        with suppress(subprocess.CalledProcessError), writing(path.with_suffix(".mp4")) as partial:
            command = [ffmpeg, *options.format(frames_per_second).split(), partial]
            subprocess.run(command, input=content.getvalue(), check=True)
