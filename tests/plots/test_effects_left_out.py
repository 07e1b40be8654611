"""Figures of extended models name the effects that they do not show."""

from __future__ import annotations

from nnode.app.python.inputs import model_options
from nnode.model import System, build_model
from nnode.model.build import add_effects
from nnode.plots.crowd import force_contours
from nnode.plots.settings import six_settings
from nnode.plots.traffic import speed_curves
from tests.diagnosis import stand_in  # noqa: F401 - registers an effect of crowds

LAW = {"name": "lin", "term": "lin", "leader": "measured", "v0": 20.0, "L": 8.0, "L_min": 2.0}
FORCE = {**model_options("sf"), "A": 1.0, "k": 1.0, "kappa": 1.0, "B": 0.1, "mass": 1.0}


def test_speed_curves_name_omitted_effects() -> None:
    def title(models: dict[str, System]) -> str:
        return speed_curves(models).axes[0].get_title(loc="left")

    plain, extended = build_model(LAW), build_model(LAW)
    add_effects(extended, [{"name": "relative_speed", "kappa": 0.3}, {"name": "inertia"}])
    assert "without" not in title({"lin": plain})
    expected = "lin+: law without relative_speed, inertia"
    assert title({"plain": plain, "lin+": extended}).endswith(expected)
    assert "effects of 3 models are not drawn" in title(dict.fromkeys("abc", extended))


def test_force_figures_name_omitted_effects() -> None:
    model = build_model(FORCE)
    assert "without" not in force_contours(model, 0).get_suptitle()
    add_effects(model, [{"name": "made_up_wind", "w_x": 0.1}])
    assert "without made_up_wind" in force_contours(model, 0).get_suptitle()
    assert "without made_up_wind" in six_settings(model)[0].get_suptitle()
