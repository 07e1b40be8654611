"""The common style of figures, and saving."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib import colormaps
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image

from nnode.errors import ConfigError
from nnode.plots.style import OKABE_ITO, SEQUENTIAL, curve_style, dress, new_figure, save

GREY = [0.2126, 0.7152, 0.0722]


@pytest.fixture
def figure() -> Figure:
    figure = new_figure(3.0, 2.0)
    dress(figure.subplots(), x="gap (m)", y="speed (m/s)")
    return figure


def test_resolution_of_files_and_notebooks(figure: Figure, tmp_path: Path) -> None:
    path = save(figure, tmp_path / "new" / "a.png")
    assert [p.name for p in path.parent.iterdir()] == ["a.png"]
    for png in (path.read_bytes(), figure._repr_png_()):  # type: ignore[attr-defined]
        assert png[:8] == b"\x89PNG\r\n\x1a\n"
        assert struct.unpack(">II", png[16:24]) == (3 * 150, 2 * 150)


def test_failed_save_keeps_the_old_file(
    figure: Figure, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = save(figure, tmp_path / "a.png")
    content, original_save = path.read_bytes(), Image.Image.save

    def failing(image, target, *values, **names):  # type: ignore[no-untyped-def]
        if isinstance(target, io.BytesIO):
            return original_save(image, target, *values, **names)
        Path(target).write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Image.Image, "save", failing)
    with pytest.raises(ConfigError, match=r"a\.png.*No space left"):
        save(figure, path)
    assert path.read_bytes() == content
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]


@pytest.mark.parametrize(
    ("name", "message"),
    [("a.pdf", r"\.png, got .*a\.pdf"), ("file/a.png", r"file/a\.png could not be written")],
)
def test_unusable_paths_are_refused(
    figure: Figure, tmp_path: Path, name: str, message: str
) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=message):
        save(figure, tmp_path / name)


def test_curves_differ_without_colour() -> None:
    styles = [curve_style(i) for i in range(len(OKABE_ITO))]
    for key in ("color", "linestyle", "marker"):
        assert len({str(style[key]) for style in styles}) == len(styles)
    assert curve_style(len(styles)) == styles[0]


def test_brightness_of_colours() -> None:
    """The sequential map is monotone, and all colours contrast with white."""
    assert (np.diff(colormaps[SEQUENTIAL](np.linspace(0, 1, 64))[:, :3] @ GREY) > 0).all()
    for name, colour in OKABE_ITO.items():
        assert np.dot(to_rgb(colour), GREY) < 0.75, name


def test_font_size_of_tick_labels(figure: Figure) -> None:
    ax = figure.axes[0]
    ax.set_xlim(0, 1000)
    figure.draw_without_rendering()
    assert {tick.get_fontsize() for tick in ax.get_xticklabels()} == {8.0}
    assert plt.get_fignums() == []  # figures are not kept open
