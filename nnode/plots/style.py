"""The common style of figures: safe for colour-blind readers and in grey, with units on axes."""

from __future__ import annotations

import io
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.axes._secondary_axes import SecondaryAxis
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.figure import Figure
from PIL import Image

from nnode.errors import ConfigError
from nnode.files import replacing

#: Okabe and Ito's palette without its yellow, which is too pale for lines on white.
#: Source: M. Okabe, K. Ito, "Color Universal Design", 2008.
OKABE_ITO = {
    "blue": "#0072B2",
    "vermillion": "#D55E00",
    "green": "#009E73",
    "purple": "#CC79A7",
    "orange": "#E69F00",
    "sky": "#56B4E9",
    "black": "#000000",
}

#: Line styles that go with the colours, so that curves differ in grey as well.
LINE_STYLES: tuple[Any, ...] = (
    "-",
    (0, (6, 2)),
    (0, (1.2, 1.4)),
    (0, (7, 2, 1.2, 2)),
    (0, (3.5, 1.2)),
    (0, (7, 1.6, 1.2, 1.6, 1.2, 1.6)),
    (0, (10, 3)),
)
MARKERS = ("o", "s", "^", "D", "v", "P", "X")

#: Sequential (monotone in grey) and diverging (ColorBrewer, colour-blind safe) colour maps.
SEQUENTIAL = "cividis"
DIVERGING = "RdBu_r"

GREY = "#666666"
SHADE = "#EFEFEF"
FONT = 9.0
SMALL_FONT = 8.0
DPI = 150


class Picture(Figure):
    """A figure that notebooks show without Matplotlib's global state."""

    def _repr_png_(self) -> bytes:
        stream = io.BytesIO()
        self.savefig(stream, format="png", dpi=DPI)
        return stream.getvalue()


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of ``width`` by ``height`` inches, outside Matplotlib's global state."""
    return Picture(figsize=(width, height), layout="constrained")


def curve_style(index: int) -> dict[str, Any]:
    """Colour, line style and marker of the ``index``-th curve, which repeat after seven."""
    i = index % len(OKABE_ITO)
    return {
        "color": list(OKABE_ITO.values())[i],
        "linestyle": LINE_STYLES[i],
        "marker": MARKERS[i],
    }


def set_ticks(axes: Axes | SecondaryAxis) -> None:
    """Give the ticks of an axes their size and colour."""
    axes.tick_params(labelsize=SMALL_FONT, length=3, width=0.6, color=GREY)


def colour_bar(
    figure: Figure, drawn: ScalarMappable, axes: Iterable[Axes], label: str, **options: Any
) -> Colorbar:
    """Draw the scale of colours beside all panels."""
    bar = figure.colorbar(drawn, ax=list(axes), aspect=30, pad=0.02, **options)
    bar.set_label(label, fontsize=FONT)
    set_ticks(bar.ax)
    return bar


def legend_above(figure: Figure, handles: list[Any], columns: int = 3) -> None:
    """Draw the legend of all panels above them."""
    figure.legend(
        handles=handles,
        loc="outside upper center",
        ncols=columns,
        frameon=False,
        fontsize=SMALL_FONT,
    )


def thinned(points: Any, number: int) -> Any:
    """At most ``number`` of the points of an array or a list, at equal steps."""
    return points[:: max(1, -(-len(points) // number))]


def with_unit(name: str, unit: str) -> str:
    """A quantity's name with its unit, if it has one."""
    return name if unit in ("", "1") else f"{name} ({unit})"


def dress(ax: Axes, *, x: str = "", y: str = "", title: str = "", grid: bool = True) -> None:
    """Give an axes its labels (with units), fonts and, behind the data, a pale grid."""
    # ticks are created late and would take the fonts that are set when the figure is drawn
    set_ticks(ax)
    for spine in ax.spines.values():
        spine.set_linewidth(0.6)
        spine.set_edgecolor(GREY)
    if x:
        ax.set_xlabel(x, fontsize=FONT)
    if y:
        ax.set_ylabel(y, fontsize=FONT)
    if title:
        ax.set_title(title, fontsize=FONT)
    ax.set_axisbelow(True)
    if grid:
        ax.grid(True, color="#DDDDDD", linewidth=0.5)


def save(figure: Figure, path: str | Path) -> Path:
    """Write a figure as PNG with 150 dots per inch.

    The file has a palette of 256 colours, which takes a third of the bytes. Missing folders are
    created. An existing file is replaced as a whole.

    Returns:
        The path.

    Raises:
        ConfigError: the path does not end in ``.png``, or its folder cannot be written to.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise ConfigError(f"figures are saved as PNG: expected a path ending in .png, got {path}")
    try:
        stream = io.BytesIO()
        figure.savefig(stream, format="png", dpi=DPI)
        with replacing(path) as temporary:
            Image.open(stream).convert("RGB").quantize(256).save(temporary, "PNG", optimize=True)
    except OSError as error:
        raise ConfigError(
            f"figure {path} could not be written ({error}); choose a folder that can be written to"
        ) from error
    return path
