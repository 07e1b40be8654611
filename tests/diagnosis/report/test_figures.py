"""Contents of a diagnosis's figures."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.collections import QuadMesh

from nnode.diagnosis.report.deviation import Deviation
from nnode.diagnosis.report.figures.maps import neighbour_maps, plane_maps, time_space_maps
from nnode.diagnosis.report.figures.marks import AFTER, BEFORE, confirmation_costs
from nnode.diagnosis.report.figures.paths import as_drawn, trajectories
from nnode.pages.replay import Scene
from tests.builders import lane


def lane_map(scale: float) -> Deviation:
    """Vehicles everywhere, with a deviation between 400 and 600 m."""
    time, place = (c.ravel() for c in np.meshgrid(np.arange(0.0, 100), np.arange(0.0, 1000, 10)))
    value = -scale * ((place > 400) & (place < 600))[:, None]
    neighbour = np.full((len(time), 2), 20.0)
    return Deviation(time, place[:, None], value, value, neighbour)


def test_maps_share_the_scale_of_before() -> None:
    figure = time_space_maps({"before": lane_map(6.0), "after": lane_map(0.5)})
    first, second = (
        next(c for c in ax.collections if isinstance(c, QuadMesh)) for ax in figure.axes[:2]
    )
    assert first.get_clim() == second.get_clim() == (-6.0, 6.0)
    edges = np.linspace(0, 990, 49)
    middle = (edges[1:] + edges[:-1]) / 2
    shown = np.asarray(first.get_array()).reshape(48, 48)
    inside = (middle > 420) & (middle < 580)
    assert (shown[inside] == -6.0).all()
    assert (shown[(middle < 380) | (middle > 620)] == 0.0).all()


def test_arrow_maps_with_missing_data() -> None:
    rng = np.random.default_rng(0)
    place = rng.uniform(0, 4, (300, 2))
    value = np.tile([0.0, 0.3], (300, 1))
    walls = np.array([[0.0, 0.0, 4.0, 0.0]])
    neighbour = np.where(rng.uniform(size=(300, 1)) < 0.1, np.nan, place - 2)
    before = Deviation(np.zeros(300), place, value, value, neighbour)
    for figure in (plane_maps({"before": before}, walls), neighbour_maps({"before": before})):
        quiver = figure.axes[0].collections[0]
        shown = np.asarray(quiver.get_array(), float)
        assert shown[np.isfinite(shown)] == pytest.approx(0.3)


def test_confirmation_costs_are_sorted_by_before() -> None:
    figure = confirmation_costs(["a", "b", "c"], [1.0, 4.0, 2.0], [0.5, 1.0, 2.5], 0.1)
    ax = figure.axes[0]
    lines = {line.get_marker(): np.asarray(line.get_ydata()) for line in ax.lines}
    assert list(lines[BEFORE["marker"]]) == [4.0, 2.0, 1.0]
    assert list(lines[AFTER["marker"]]) == [1.0, 2.5, 0.5]
    assert [label.get_text() for label in ax.get_xticklabels()] == ["b", "c", "a"]


def test_trajectories_show_simulated_minus_measured() -> None:
    time = 0.2 * np.arange(21)
    s = lane(15 * time[:, None] + np.array([0.0, 20.0, 45.0]))
    slow = s.x - 0.5 * time[:, None, None]
    figure = trajectories(s, as_drawn(Scene(s, {"without": slow, "with": s.x})))
    for ax, expected in zip(figure.axes[2:], (-0.5 * time, 0 * time), strict=True):
        shown = [np.asarray(line.get_ydata()) for line in ax.lines[1:]]
        np.testing.assert_allclose(shown, np.tile(expected, (3, 1)), atol=1e-12)
