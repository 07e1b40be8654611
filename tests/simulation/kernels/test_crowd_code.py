"""Compiled crowd code: one module for one law, and its source."""

from __future__ import annotations

from nnode.model import Crowd, make_law
from nnode.model.formula import crowd_of
from nnode.simulation.kernels import source
from nnode.simulation.kernels.crowds import CrowdSource
from tests.builders import social_forces


def test_one_law_of_other_bodies_is_one_module() -> None:
    one, other = (
        make_law("social_force", A=1.0, k=2.0, kappa=3.0),
        make_law("social_force", A=4.0, k=5.0, kappa=6.0, r=0.3, B=0.2, mass=70.0),
    )
    texts = set()
    for force in (one, other):
        law = crowd_of([make_law("relaxation", tau=0.1 * len(texts) + 0.4), force])
        assert law is not None
        texts.add(CrowdSource(law).text())
    assert len(texts) == 1


def test_its_source_is_shown() -> None:
    text = source(Crowd(social_forces(A=1.0, k=2.0, kappa=3.0)))
    assert "social_force.pair_x = sum over others of" in text
    assert "def backward(" in text
