"""The paper's six settings agree with its printed table."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from matplotlib.quiver import Quiver

from nnode.model import Crowd, make_law
from nnode.plots import save, six_settings
from nnode.plots.settings import Setting

#: Printed calibrated values (section 6.5), and half a unit of their last digit.
PRINTED = {"A": 0.0044, "k": 34.9539, "kappa": 9.8894}
HALF = 0.5e-4

#: Table (data6settings): x_blue, v_blue, force_blue, force_red; x_red = -x_blue, v_red = (0, 1).
TABLE = {
    "S1": ((0, 0.22), (0, -1), (0, 2.1118), (0, -2.1118)),
    "S2": ((0, 0.22), (0, 1), (0, 2.1118), (0, -2.1118)),
    "S3": ((0.01, 0.22), (0, -1), (0.0417, 2.0961), (-0.0417, -2.0961)),
    "S4": ((0.01, 0.22), (0, 1), (0.0952, 2.0936), (-0.0952, -2.0936)),
    "S5": ((0.22, 0), (0, -1), (2.1118, 1.1867), (-2.1118, -1.1867)),
    "S6": ((0.22, 0), (0, 1), (2.1118, 0), (-2.1118, 0)),
}


def _social(B: float = 0.05) -> Crowd:
    force = make_law("social_force", **PRINTED, r=0.25, B=B)
    return Crowd([make_law("relaxation", tau=0.5), force]).double()


def _tolerance(x_blue, v_blue) -> np.ndarray:
    """Rounding errors of the printed force and of the three printed parameters, ``(2,)`` N."""
    dx = 2 * np.array(x_blue, dtype=float)
    dv = np.array(v_blue, dtype=float) - (0, 1)
    d = np.hypot(*dx)
    n = dx / d
    t = np.array([-n[1], n[0]])
    overlap = 0.5 - d
    parameters = (
        np.exp(overlap / 0.05) * np.abs(n) + overlap * np.abs(n) + overlap * abs(dv @ t) * np.abs(t)
    )
    return HALF + HALF * parameters + 1e-6  # and float32 parameters


@pytest.mark.parametrize("name", TABLE)
def test_printed_forces(name: str) -> None:
    x_blue, v_blue, blue, red = TABLE[name]
    _, table = six_settings(_social())
    row = table.set_index("setting").loc[name]
    assert row["x_blue"] == x_blue
    assert row["v_blue"] == v_blue
    assert row["x_red"] == tuple(-c for c in x_blue)
    assert row["v_red"] == (0, 1)
    tolerance = _tolerance(x_blue, v_blue)
    assert (tolerance < 3e-4).all()
    assert (np.abs(np.subtract(row["force_blue"], blue)) <= tolerance).all()
    assert (np.abs(np.subtract(row["force_red"], red)) <= tolerance).all()


def test_other_B_gives_other_forces() -> None:
    _, table = six_settings(_social(B=0.1))
    assert table["force_blue"][0] == pytest.approx((0.0, 2.1052), abs=HALF + 1e-5)


def test_settings_and_parts_of_networks() -> None:
    force = make_law("network_force", generator=torch.Generator().manual_seed(0)).double()
    table, *parts = (six_settings(Crowd([force]), part=part)[1] for part in (None, "pair", "wall"))
    columns = "setting x_blue x_red v_blue v_red force_blue force_red"
    assert list(table.columns) == columns.split()
    assert list(table["setting"]) == [*TABLE]
    blue = [(0, 4), (0, 4), (0.01, 4), (0.01, 4), (0.5, 0), (0.5, 0)]
    assert list(table["x_blue"]) == blue
    assert list(table["x_red"]) == [(-x, -y) for x, y in blue]
    assert list(table["v_blue"]) == [(0, -1), (0, 1)] * 3
    assert set(table["v_red"]) == {(0, 1)}
    total, pair, wall = (np.array([*part["force_red"]]) for part in (table, *parts))
    np.testing.assert_allclose(total, pair + wall, rtol=1e-12)
    # red of S2: x_red - x_blue = (0, -8), equal velocities
    with torch.no_grad():
        at = torch.tensor([0.0, -8.0, 0.0, 0.0], dtype=torch.float64)
        np.testing.assert_allclose(pair[1], force.pair(at))
        np.testing.assert_allclose(wall[1], force.wall(at))


def test_arrows_agree_with_the_table() -> None:
    figure, table = six_settings(_social())
    panels = [ax for ax in figure.axes if ax.get_title()]
    assert [ax.get_title() for ax in panels] == list(table["setting"])
    scales = set()
    for ax, (_, row) in zip(panels, table.iterrows(), strict=True):
        assert (ax.get_xlabel(), ax.get_ylabel()) == ("x (m)", "y (m)")
        arrows = [c for c in ax.collections if isinstance(c, Quiver)]
        drawn = {(a.get_gid(), *a.XY[0], a.U[0], a.V[0]) for a in arrows}
        assert drawn == {
            (kind, *row[f"x_{person}"], *row[f"{kind}_{person}"])
            for kind in ("v", "force")
            for person in ("blue", "red")
        }
        scales |= {(a.get_gid(), a.scale, a.scale_units) for a in arrows}
    assert len(scales) == 2  # one for velocities, one for forces
    legend = " ".join(text.get_text() for ax in figure.axes for text in ax.texts)
    assert "this long: 1 m/s" in legend
    longest = max(np.hypot(*force) for force in table["force_blue"])
    assert f"this long: {longest:.3g} N" in legend


def test_user_s_settings(tmp_path) -> None:
    settings = [Setting("close", (0.1, 0.0), (-0.1, 0.0), (0.0, 0.0), (0.0, 0.0))]
    figure, table = six_settings(_social(), settings)
    # at rest only the normal force acts: A exp(0.3 / 0.05) + 0.3 k
    force = 0.0044 * np.exp(6.0) + 0.3 * 34.9539
    assert table["force_blue"][0] == pytest.approx((force, 0.0), rel=1e-5)
    save(figure, tmp_path / "a.png")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [0.0, float("nan")])
def test_degenerate_models_are_drawn(value: float, tmp_path) -> None:
    system = _social()
    with torch.no_grad():
        for parameter in system.parameters():
            parameter.fill_(value)
    figure, table = six_settings(system)
    np.testing.assert_equal(np.abs(np.array([*table["force_red"]])).max(), value)
    assert save(figure, tmp_path / "a.png").stat().st_size > 0
