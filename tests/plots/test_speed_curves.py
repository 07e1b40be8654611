"""Figures of speed over gap."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.io import loadmat

from nnode.errors import ConfigError, DataError
from nnode.model import Crowd, System, Traffic, make_law
from nnode.plots import curve_table, measured_gaps, save, speed_curves
from nnode.plots.traffic import SHOWN
from tests.builders import lane, people


def _models() -> dict[str, System]:
    generator = torch.Generator().manual_seed(0)
    return {
        "lin": Traffic([make_law("lin", v0=22.0, L=4.69)]).double(),
        "log": Traffic([make_law("log", v0=21.0, L=8.43)]).double(),
        "n4": Traffic([make_law("network_speed", hidden=4, v0=20.0, generator=generator)]),
    }


def _line(figure, gid):
    (line,) = [line for line in figure.axes[0].get_lines() if line.get_gid() == gid]
    return line


def _text(figure):
    """All labels and notes of a figure."""
    words = []
    for ax in figure.axes:
        words += [ax.get_xlabel(), ax.get_ylabel(), ax.get_title(), ax.get_title("left")]
        words += [child.get_ylabel() for child in ax.child_axes]
    return words


def test_table_agrees_with_the_formulas() -> None:
    gaps = np.array([3.0, 8.43, 20.0, 47.5])
    table = curve_table(_models(), gaps)
    assert table.index.name == "gap"
    assert list(table) == ["lin", "log", "n4"]
    np.testing.assert_allclose(table.index, gaps)
    for gap, row in table.iterrows():
        assert row["lin"] == pytest.approx(22.0 * (1 - 4.69 / gap), rel=1e-6)
        assert row["log"] == pytest.approx(21.0 * math.log(gap / 8.43), rel=1e-6, abs=1e-5)


def test_curves_agree_with_the_formulas() -> None:
    figure = speed_curves(_models())
    lin, log = _line(figure, "curve:lin"), _line(figure, "curve:log")
    gap = lin.get_xdata()
    assert (gap[0], gap[-1]) == (2.0, 50.0)
    np.testing.assert_allclose(lin.get_ydata(), 22.0 * (1 - 4.69 / gap), rtol=1e-6)
    np.testing.assert_allclose(log.get_ydata(), 21.0 * np.log(gap / 8.43), rtol=1e-5, atol=1e-5)
    for name, v0 in (("lin", 22.0), ("log", 21.0), ("n4", 20.0)):
        np.testing.assert_allclose(_line(figure, f"v0:{name}").get_ydata(), v0)


def test_axes_in_metres_per_second_and_kilometres_per_hour() -> None:
    figure = speed_curves(_models(), np.linspace(5, 40, 100))
    assert {"speed W (m/s)", "speed W (km/h)", "gap (m)"} <= set(_text(figure))
    ax = figure.axes[0]
    figure.draw_without_rendering()
    np.testing.assert_allclose(ax.child_axes[0].get_ylim(), np.multiply(ax.get_ylim(), 3.6))


def test_curves_are_pale_outside_the_measured_gaps() -> None:
    gaps = np.linspace(10.0, 30.0, 2001)  # percentiles 1 and 99: 10.2 m and 29.8 m
    figure = speed_curves(_models(), gaps)
    solid, pale = _line(figure, "curve:lin"), _line(figure, "unsupported:lin")
    gap = solid.get_xdata()
    inside = np.isfinite(solid.get_ydata())
    np.testing.assert_array_equal(inside, (gap >= 10.2) & (gap <= 29.8))
    speed = np.where(inside, solid.get_ydata(), pale.get_ydata())
    np.testing.assert_allclose(speed, 22.0 * (1 - 4.69 / gap), rtol=1e-6)
    assert pale.get_alpha() < 0.5
    heights = [bar.get_height() for bar in figure.axes[1].containers[0]]
    assert sum(heights) == len(gaps)
    assert not any("outside" in word for word in _text(figure))


def test_gaps_outside_the_figure_are_counted() -> None:
    figure = speed_curves(_models(), np.array([-3.0, 10.0, 20.0, 30.0, 1e4]))
    assert sum(bar.get_height() for bar in figure.axes[1].containers[0]) == 3
    assert any("40.0% of the gaps lie outside" in word for word in _text(figure))
    assert figure.axes[0].get_xlim() == (2.0, 50.0)


def test_extreme_speeds_are_cut_with_a_note() -> None:
    low = speed_curves(_models())
    assert low.axes[0].get_ylim()[0] == SHOWN[0]
    assert any("below −20 m/s" in word for word in _text(low))
    uncut = speed_curves({"lin": Traffic([make_law("lin", v0=10.0, L=3.0)])})
    assert not any("cut" in word for word in _text(uncut))
    high = speed_curves({"lin": Traffic([make_law("lin", v0=400.0, L=4.0)])})
    assert high.axes[0].get_ylim()[1] == SHOWN[1]
    assert any("above 60 m/s" in word for word in _text(high))


def test_many_models_have_a_short_legend() -> None:
    models = {f"step {i}": Traffic([make_law("lin", v0=20.0 + i / 5)]) for i in range(50)}
    figure = speed_curves(models, np.linspace(5, 40, 100))
    lines = [ln for ln in figure.axes[0].get_lines() if str(ln.get_gid()).startswith("curve:")]
    assert len(lines) == 50
    legend = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert len(legend) <= 5
    assert {"step 0", "step 49"} <= set(legend)
    grey = [np.dot(line.get_color()[:3], [0.2126, 0.7152, 0.0722]) for line in lines]
    assert (np.diff(grey) < 0).all()


def test_measured_leader_has_no_v0_line() -> None:
    figure = speed_curves({"lin": Traffic([make_law("lin")], leader="measured")})
    assert not any(str(ln.get_gid()).startswith("v0") for ln in figure.axes[0].get_lines())


def _zero() -> System:
    system = Traffic([make_law("network_speed", hidden=4, v0=0.0)])
    with torch.no_grad():
        for weight in system.parameters():
            weight.zero_()
    return system


@pytest.mark.parametrize(
    "system",
    [
        _zero(),
        Traffic([make_law("lin", v0=0.0, L=5.0)]),
        Traffic([make_law("log", v0=0.0, L=5.0)]),
        Traffic([make_law("lin", v0=float("nan"), L=5.0)]),
        Traffic([make_law("lin", v0=float("inf"), L=5.0)]),
    ],
    ids=["zero weights", "lin v0=0", "log v0=0", "nan", "inf"],
)
@pytest.mark.filterwarnings("error")
def test_degenerate_models_are_drawn(system: System, tmp_path: Path) -> None:
    figure = speed_curves({"m": system}, np.full(7, 12.0))
    assert np.isfinite(figure.axes[0].get_ylim()).all()
    assert save(figure, tmp_path / "a.png").stat().st_size > 0
    not_finite = not torch.isfinite(torch.cat([p.ravel() for p in system.parameters()])).all()
    assert any("not finite everywhere: m" in word for word in _text(figure)) == not_finite


def test_invalid_models_are_refused() -> None:
    with pytest.raises(ConfigError, match="at least one model"):
        speed_curves({})
    with pytest.raises(ConfigError, match=r"walkers: .*found a crowd model.*relaxation"):
        speed_curves({"walkers": Crowd([make_law("relaxation")])})


def test_measured_gaps() -> None:
    sequence = lane([[0.0, 5.0, 30.0], [1.0, 7.0, 33.0]])
    assert sorted(measured_gaps([sequence, sequence])) == [5, 5, 6, 6, 25, 25, 26, 26]
    with pytest.raises(DataError, match="sequence p"):
        measured_gaps([people(np.zeros((1, 2, 2)), 1.0, name="p")])


@pytest.mark.real
def test_histogram_counts_all_real_gaps(real_data: Path) -> None:
    gaps = []
    for path in sorted((real_data / "esimas").glob("sequence_data1-1_*.mat")):
        for item in np.atleast_1d(loadmat(path, simplify_cells=True)["sequences"]):
            gaps.append(np.diff(item["Xarr"], axis=0).ravel())
    gap = np.concatenate(gaps)
    figure = speed_curves(_models(), gap)
    shown = sum(bar.get_height() for bar in figure.axes[1].containers[0])
    assert 0 < shown == ((gap >= 2.0) & (gap <= 50.0)).sum() < len(gap)
