"""Candidate effects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nnode.calibrate.parameters import ParameterVector
from nnode.diagnosis.candidate import Candidate
from nnode.diagnosis.residuals.comparison import Comparison
from nnode.diagnosis.statistics.score import Score
from nnode.model.effects import CATALOGUE
from nnode.model.extend import extended
from nnode.model.system import Crowd
from tests.builders import regression, social_forces


def test_uncertain_setting_does_not_make_a_strength_neutral() -> None:
    rng = np.random.default_rng(7)
    effect = CATALOGUE.effects["pair_repulsion"]
    system, place = extended(Crowd(social_forces()), effect())
    names = list(ParameterVector(system).names)
    columns = rng.normal(size=(600, len(names)))
    of_strength, of_setting = (names.index(f"terms.{place}.{name}") for name in ("A_2", "B_2"))
    columns[:, of_setting] = columns[:, of_strength] + 0.01 * rng.normal(size=600)
    residual = rng.normal(size=600) - 3 * columns[:, of_strength]
    fit = replace(regression(columns, residual), system=system, names=names)
    cluster = np.repeat(np.arange(12), 50)
    low, high = fit.jackknife_intervals(cluster)[of_strength]
    assert low < 0 < high
    score = Score(effect, {}, 0.0, 1.0, 0.0, {}, {})
    candidate = Candidate(score, fit, np.zeros(12), Comparison(0.0, -1.0, 1.0, 1.0, 12), 1.0)
    assert candidate.strength_excludes_neutral(cluster)
