"""Figures of extended models say which effects they do not show."""

from __future__ import annotations

from nnode.app.python.inputs import model_options
from nnode.model import build_model
from nnode.model.build import add_effects
from nnode.plots.crowd import force_contours
from nnode.plots.settings import six_settings
from nnode.plots.traffic import speed_curves
from tests.diagnosis import stand_in  # noqa: F401 - registers an effect of crowds

LAW = {"name": "lin", "term": "lin", "leader": "measured", "v0": 20.0, "L": 8.0, "L_min": 2.0}
FORCE = {**model_options("sf"), "A": 1.0, "k": 1.0, "kappa": 1.0, "B": 0.1, "mass": 1.0}


def test_a_speed_curve_says_which_effects_it_leaves_out() -> None:
    plain, extended = build_model(LAW), build_model(LAW)
    add_effects(extended, [{"name": "relative_speed", "kappa": 0.3}, {"name": "inertia"}])
    title = speed_curves({"lin": plain}).axes[0].get_title(loc="left")
    assert "without" not in title
    title = speed_curves({"plain": plain, "lin+": extended}).axes[0].get_title(loc="left")
    assert title.endswith("lin+: law without relative_speed, inertia")
    many = {f"m{i}": extended for i in range(3)}
    assert "effects of 3 models are not drawn" in speed_curves(many).axes[0].get_title(loc="left")


def test_force_figures_say_which_effects_they_leave_out() -> None:
    model = build_model(FORCE)
    assert "without" not in force_contours(model, 0).get_suptitle()
    add_effects(model, [{"name": "made_up_wind", "w_x": 0.1}])
    assert "without made_up_wind" in force_contours(model, 0).get_suptitle()
    assert "without made_up_wind" in six_settings(model)[0].get_suptitle()
