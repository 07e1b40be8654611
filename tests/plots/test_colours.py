"""Colours are distinguishable with colour vision deficiencies.

The matrices are those of complete protanopia, deuteranopia and tritanopia in Machado, Oliveira and
Fernandes, "A physiologically-based model for simulation of color vision deficiency", IEEE TVCG 15
(2009), for linear RGB. Distances are Euclidean in CIELAB (1976, white D65), where about 2.3 is just
noticeable.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from nnode.diagnosis.report.figures.marks import AFTER, BEFORE
from nnode.plots.quality import STYLES
from nnode.plots.style import GREY, OKABE_ITO

VISION = {
    "normal": np.eye(3),
    "protanopia": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "tritanopia": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
}

#: Linear sRGB to XYZ, IEC 61966-2-1, and its white.
XYZ = np.array(
    [
        [0.4124564, 0.3575761, 0.1804375],
        [0.2126729, 0.7151522, 0.0721750],
        [0.0193339, 0.1191920, 0.9503041],
    ]
)
WHITE = XYZ.sum(1)

#: Minimum distance of colours that also differ in line style and marker, and of other colours.
WITH_MARKERS, COLOUR_ONLY = 15.0, 25.0


def lab(colour: str, vision: str) -> np.ndarray:
    """CIELAB coordinates of a colour as perceived with a kind of vision."""
    srgb = np.array(to_rgb(colour))
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    ratio = XYZ @ np.clip(np.array(VISION[vision]) @ linear, 0, 1) / WHITE
    f = np.where(ratio > 216 / 24389, np.cbrt(ratio), (24389 / 27 * ratio + 16) / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def distance(a: str, b: str, vision: str) -> float:
    return float(np.linalg.norm(lab(a, vision) - lab(b, vision)))


def test_conversion_agrees_with_the_literature() -> None:
    assert lab("#ffffff", "normal") == pytest.approx([100, 0, 0], abs=1e-6)
    # the primary red of sRGB in CIELAB, D65
    assert lab("#ff0000", "normal") == pytest.approx([53.24, 80.09, 67.20], abs=0.02)
    for vision in VISION:  # greys are perceived alike
        assert lab("#777777", vision) == pytest.approx(lab("#777777", "normal"), abs=0.05)
    # a common pair of colours that deuteranopes confuse
    assert distance("#d62728", "#2ca02c", "normal") > 100
    assert distance("#c44e00", "#6c7a00", "deuteranopia") < WITH_MARKERS


@pytest.mark.parametrize("vision", VISION)
def test_palette_is_distinguishable(vision: str) -> None:
    for a, b in combinations(OKABE_ITO, 2):
        assert distance(OKABE_ITO[a], OKABE_ITO[b], vision) > WITH_MARKERS, (a, b)


@pytest.mark.parametrize("vision", VISION)
def test_colours_without_markers_are_distinguishable(vision: str) -> None:
    for a, b in combinations((BEFORE["color"], AFTER["color"], GREY, "#ffffff"), 2):
        assert distance(a, b, vision) > COLOUR_ONLY, (a, b)


def test_markers_differ() -> None:
    assert BEFORE["marker"] != AFTER["marker"]
    markers = [marker for _, marker in STYLES.values()]
    assert len(set(markers)) == len(markers)
