"""The common look, and saving."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib import colormaps
from matplotlib.colors import to_rgb
from PIL import Image

from nnode.errors import ConfigError
from nnode.plots.style import DPI, OKABE_ITO, SEQUENTIAL, curve_style, dress, new_figure, save


def _figure(width=3.0, height=2.0):
    figure = new_figure(width, height)
    dress(figure.subplots(), x="gap (m)", y="speed (m/s)")
    return figure


def test_save_writes_png_of_150_dpi(tmp_path: Path) -> None:
    path = save(_figure(), tmp_path / "new" / "a.png")
    head = path.read_bytes()[:24]
    assert head[:8] == b"\x89PNG\r\n\x1a\n"
    assert struct.unpack(">II", head[16:24]) == (3 * 150, 2 * 150)
    assert DPI == 150
    assert [p.name for p in path.parent.iterdir()] == ["a.png"]


def test_notebooks_show_a_figure() -> None:
    head = _figure()._repr_png_()[:24]
    assert head[:8] == b"\x89PNG\r\n\x1a\n"
    assert struct.unpack(">II", head[16:24]) == (3 * 150, 2 * 150)


def test_failed_save_keeps_the_old_file_and_leaves_nothing(tmp_path: Path, monkeypatch) -> None:
    path = save(_figure(), tmp_path / "a.png")
    before = path.read_bytes()
    whole = Image.Image.save

    def half(image, target, *values, **names):
        if isinstance(target, io.BytesIO):
            return whole(image, target, *values, **names)
        Path(target).write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Image.Image, "save", half)
    with pytest.raises(ConfigError, match=r"a\.png.*No space left"):
        save(_figure(), path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]


def test_save_names_bad_paths(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"\.png, got .*a\.pdf"):
        save(_figure(), tmp_path / "a.pdf")
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"file/a\.png could not be written"):
        save(_figure(), tmp_path / "file" / "a.png")


def test_figures_are_not_kept_open() -> None:
    _figure()
    assert plt.get_fignums() == []


def test_curves_differ_without_colour() -> None:
    styles = [curve_style(i) for i in range(len(OKABE_ITO))]
    for key in ("color", "linestyle", "marker"):
        assert len({str(style[key]) for style in styles}) == len(styles)
    assert curve_style(len(styles)) == styles[0]


def test_sequential_map_is_monotone_in_grey() -> None:
    luminance = colormaps[SEQUENTIAL](np.linspace(0, 1, 64))[:, :3] @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(luminance) > 0).all()


def test_colours_stand_out_from_white() -> None:
    for name, colour in OKABE_ITO.items():
        assert np.dot(to_rgb(colour), [0.2126, 0.7152, 0.0722]) < 0.75, name


def test_dress_sets_the_fonts_of_ticks_drawn_later() -> None:
    figure = _figure()
    ax = figure.axes[0]
    ax.set_xlim(0, 1000)
    figure.draw_without_rendering()
    assert {tick.get_fontsize() for tick in ax.get_xticklabels()} == {8.0}
