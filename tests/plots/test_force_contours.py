"""Contour plots of forces, and the overview figure of any model."""

from __future__ import annotations

from copy import deepcopy

import numpy as np
import pytest
import torch
from matplotlib.contour import ContourSet
from torch import Tensor

from nnode.errors import ConfigError
from nnode.model import Crowd, InteractionForce, Traffic, make_law
from nnode.plots import force_contours, force_figure, save
from nnode.plots.crowd import ENCOUNTERS
from nnode.plots.interaction import evaluate_force

PAPER = {"A": 0.0044, "k": 34.9539, "kappa": 9.8894}


class Spring(InteractionForce):
    """A force with known contours: 2 dx + 3 dv between people, -dx from walls."""

    name = "spring"
    formula = "2 dx + 3 dv"
    source = "none"

    def pair_force(self, dx: Tensor, dv: Tensor) -> Tensor:
        return 2 * dx + 3 * dv

    def wall_force(self, dx: Tensor, v: Tensor, normal: Tensor) -> Tensor:
        return -dx


def _social() -> Crowd:
    return Crowd([make_law("social_force", **PAPER)])


def _network() -> Crowd:
    generator = torch.Generator().manual_seed(1)
    return Crowd([make_law("relaxation"), make_law("network_force", generator=generator)])


MODELS = pytest.mark.parametrize("system", [_social(), _network()], ids=["sf", "nn"])


def _panels(figure):
    return [ax for ax in figure.axes if ax.get_title()]


def _contours(ax, filled):
    return [c for c in ax.collections if isinstance(c, ContourSet) and c.filled == filled]


@pytest.mark.parametrize("component", [0, 1])
@pytest.mark.parametrize(
    ("part", "slope", "damping"), [("pair", 2, 3), ("wall", -1, 0), (None, 1, 3)]
)
def test_contours_lie_at_their_levels(component, part, slope, damping) -> None:
    figure = force_contours(Crowd([Spring()]), component, part=part)
    count = 0
    for ax, dv in zip(_panels(figure), ENCOUNTERS, strict=True):
        assert ax.get_xlim() == (-4.0, 4.0)
        for lines in _contours(ax, filled=False):
            for level, path in zip(lines.levels, lines.get_paths(), strict=True):
                position = (level - damping * dv[component]) / slope
                np.testing.assert_allclose(path.vertices[:, component], position, atol=1e-6)
                assert (lines.linestyles == "dashed") == (level < 0)
                count += 1
    assert count > 4


@pytest.mark.parametrize("component", [0, 1])
@MODELS
def test_panels_share_a_symmetric_scale(system, component) -> None:
    figure = force_contours(system, component)
    levels = [tuple(_contours(ax, filled=True)[0].levels) for ax in _panels(figure)]
    assert len(levels) == 4
    assert len(set(levels)) == 1
    np.testing.assert_allclose(levels[0], -np.array(levels[0])[::-1], atol=1e-12)
    assert len(levels[0]) % 2 == 0  # a neutral colour around zero


def test_extents_follow_the_paper() -> None:
    social, network = _social(), _network()
    assert _panels(force_contours(social, 0))[0].get_xlim() == (-0.5, 0.5)
    assert _panels(force_contours(network, 0))[0].get_xlim() == (-4.0, 4.0)
    assert _panels(force_contours(social, 0, extent=1.5))[3].get_ylim() == (-1.5, 1.5)


def test_labels_units_and_velocities() -> None:
    figure = force_contours(_social(), 1)
    panels = _panels(figure)
    assert panels[2].get_xlabel() == "$x_i - x_j$ (m)"
    assert panels[0].get_ylabel() == "$y_i - y_j$ (m)"
    for ax, (dv, encounter) in zip(panels, ENCOUNTERS.items(), strict=True):
        assert encounter in ax.get_title()
        assert f"({dv[0]:g}, {dv[1]:g}) m/s" in ax.get_title()
    assert (2.0, 0.0) in ENCOUNTERS
    (bar,) = [ax for ax in figure.axes if ax not in panels]
    assert "$F_y$ (N)" in bar.get_ylabel()
    # the peak of the repulsion would hide all other values
    assert "the scale ends below the peak" in figure.get_suptitle()


def test_social_force_agrees_with_its_formula() -> None:
    system = _social().double()
    dx, dv = np.random.default_rng(0).uniform(-0.5, 0.5, (2, 500, 2))
    force = evaluate_force(system, dx, dv)
    np.testing.assert_allclose(force, -evaluate_force(system, -dx, -dv), rtol=1e-12)
    distance = np.hypot(*dx.T)
    normal = dx / distance[:, None]
    tangent = np.stack([-normal[:, 1], normal[:, 0]], 1)
    overlap = np.maximum(0.5 - distance, 0)
    normal_force = 0.0044 * np.exp((0.5 - distance) / 0.05) + 34.9539 * overlap
    tangential_force = -9.8894 * overlap * (dv * tangent).sum(1)
    expected = normal_force[:, None] * normal + tangential_force[:, None] * tangent
    np.testing.assert_allclose(force, expected, rtol=1e-4, atol=1e-6)


def test_network_force_is_not_antisymmetric() -> None:
    dx, dv = np.array([1.0, 0.5]), np.array([2.0, 0.0])
    force = evaluate_force(_network(), dx, dv)
    assert not np.allclose(force, -evaluate_force(_network(), -dx, -dv), rtol=0.01)


def test_parts_without_walls() -> None:
    system = Crowd([make_law("network_force", walls=False)])
    dx = np.ones((3, 2))
    np.testing.assert_array_equal(
        evaluate_force(system, dx, dx), evaluate_force(system, dx, dx, "pair")
    )
    with pytest.raises(ConfigError, match="part=wall"):
        force_contours(system, 0, part="wall")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [0.0, float("nan"), float("inf")])
@MODELS
def test_degenerate_models_are_drawn(system: Crowd, value: float, tmp_path) -> None:
    system = deepcopy(system)
    with torch.no_grad():
        for parameter in system.parameters():
            parameter.fill_(value)
    figure = force_figure(system)
    assert save(figure, tmp_path / "a.png").stat().st_size > 0
    assert ("not finite" in figure.get_suptitle()) == (value != 0.0)
    for ax in _panels(figure):
        assert np.isfinite(_contours(ax, filled=True)[0].levels).all()


def test_invalid_options_are_refused() -> None:
    for extent in (0.0, -1.0, float("nan")):
        with pytest.raises(ConfigError, match="extent"):
            force_contours(_social(), 0, extent=extent)
    for model, message in (
        (Crowd([make_law("relaxation")]), r"crowd model.*relaxation"),
        (Traffic([make_law("lin")]), r"found a traffic model.*lin"),
    ):
        with pytest.raises(ConfigError, match=message):
            force_contours(model, 0)


@pytest.mark.parametrize(
    ("system", "titles"),
    [(Traffic([make_law("network_speed", hidden=4)]), 0), (_social(), 2), (_network(), 2)],
    ids=["traffic", "sf", "nn"],
)
def test_overview_of_every_domain(system, titles, tmp_path) -> None:
    figure = force_figure(system)
    save(figure, tmp_path / "a.png")
    assert len(_panels(figure)) == titles
    labels = [f"{ax.get_xlabel()} {ax.get_ylabel()}" for ax in figure.axes]
    assert all("(m" in label or "(N)" in label for label in labels)
    for ax in _panels(figure):
        assert "(2, 0) m/s" in ax.get_title()
