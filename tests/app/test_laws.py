"""The printed catalogue of laws and effects."""

from __future__ import annotations

from nnode.app.laws import lines
from nnode.model.effects import CATALOGUE
from nnode.model.laws import CAR_FOLLOWING_LAWS


def test_all_laws_and_effects_are_printed() -> None:
    printed = "\n".join(lines())
    built_in = ("lin", "log", "network_speed", "social_force", "network_force")
    for name in (*built_in, *CAR_FOLLOWING_LAWS):
        assert f"\n  {name}:" in printed
    for domain in ("traffic", "crowd"):
        for effect in CATALOGUE.of(domain, every=True):  # type: ignore[arg-type]
            if not effect.__module__.startswith("nnode."):
                continue  # from another test
            assert f"\n  {effect.name}: " in printed
            assert effect.source in printed
    for formula in (
        "W becomes W + kappa*(dx_1 - W)",
        "dx/dt = v0 - v0*L/gap",
        "dv/dt = a*(1 - (v/v0)**4 - (wish/net)**2)",
        "dv/dt = NN(gap/20, v/10, dv/2)\n    NN: 4 neurons",
        "of an acceleration, W becomes W - kappa*dv/per",
        "of an acceleration, W becomes late\n    late = W, T ago (at most 15 steps)",
        "dq/dt = (T - q)/tau_m, at the start clip(",
        "of an acceleration, the same",
    ):
        assert formula in printed
    assert printed.count("edge = 2 m") == 2  # speed_zone and slope, once each
    assert "\\" not in printed
