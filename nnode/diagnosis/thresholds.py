"""Levels and thresholds of the decisions of a diagnosis, each with its reason.

They apply in addition to ``discover.alpha``. The sensitivity of true and false positives to halving
and doubling each: ``benchmark_discovery.kinds=[rules]``, which needs them to be read as attributes
of this module.
"""

#: Level of the tests between models in exploration clusters: score tests on held-out clusters,
#: J tests between effects, comparisons of effects with curves.
LEVEL = 0.05
#: Level that the first screen and the confirmation clusters must each reach on their own. The error
#: rate is that of both together, ``discover.alpha``; without this one, strong evidence in one part
#: would name an effect that the other part contradicts.
EACH = 0.25
#: Stricter level, where errors mislead most: unexplained structure, and similar effects.
STRICT = 0.01
#: Smallest share of the squared errors that is worth naming.
SMALLEST_SHARE = 0.02
#: Negligible share of an effect's minimum size; a crowd's bias is smaller.
NEGLIGIBLE = 0.1
#: Share of the best score's gain from which effects are calibrated, which limits the time.
RIVAL = 0.25
#: Share of the best held-out gain from which a simpler effect is as good.
AS_GOOD = 0.97
#: Largest ratio of the decreases of held-out costs by a remaining curve and by the named effects.
#: The table in docs/discovery.md has these ratios for data with known effects.
UNEXPLAINED = 0.25
#: Smallest share of an effect's estimate inside its plausible range, below which it indicates
#: another effect; the linear estimate of a strong effect may overshoot.
PLAUSIBLE = 0.2
#: Ridge of the autoregressive filter, relative to the past residuals. Without noise, a wrong
#: model's residuals are smooth and could be extrapolated almost exactly. A value of 0.1 costs
#: effects that are added second a tenth of their standardised distance.
RIDGE = 0.03
#: Prior weight of the pooled variance, in clusters.
PRIOR = 12.0
#: Power that counts as detectable (Cohen 1988).
POWER = 0.8
