"""A simple formula that describes a curve, as a hint."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

#: Form to its columns in addition to a constant, at standardised places in [0, 1].
FORMS: dict[str, Callable[[np.ndarray], list[np.ndarray]]] = {
    "constant": lambda u: [],
    "{a:+.3g} z": lambda u: [u],
    "{a:+.3g} z {b:+.3g} z²": lambda u: [u, u**2],
    "{a:+.3g} exp(-4 z)": lambda u: [np.exp(-4 * u)],
    "{a:+.3g} sin(2 pi z) {b:+.3g} cos(2 pi z)": lambda u: [
        np.sin(2 * np.pi * u),
        np.cos(2 * np.pi * u),
    ],
    "{a:+.3g} sin(4 pi z) {b:+.3g} cos(4 pi z)": lambda u: [
        np.sin(4 * np.pi * u),
        np.cos(4 * np.pi * u),
    ],
}


def symbolic(name: str, at: np.ndarray, heights: np.ndarray, errors: np.ndarray) -> str:
    """The form with the least Bayesian information criterion, in words.

    Args:
        name: of the variable.
        at: ``(M,)`` its values.
        heights, errors: ``(M,)`` the curve at these values.
    """
    u = (at - at[0]) / (at[-1] - at[0])
    best = None
    for form, columns in FORMS.items():
        design = np.stack([np.ones_like(u), *columns(u)], 1) / errors[:, None]
        if design.shape[1] >= len(u):
            continue
        weights, *_ = np.linalg.lstsq(design, heights / errors, rcond=None)
        residuals = heights / errors - design @ weights
        value = float(residuals @ residuals) + design.shape[1] * np.log(len(u))
        if best is None or value < best[0]:
            best = value, form, weights
    assert best is not None
    _, form, weights = best
    numbers = dict(zip("ab", weights[1:], strict=False))
    if form == "constant":
        return f"{weights[0]:.3g}, whatever the {name}"
    sign = "+" if at[0] < 0 else "-"
    return (
        f"{weights[0]:.3g} {form.format(**numbers)} with z = ({name} {sign} {abs(at[0]):.4g}) / "
        f"{at[-1] - at[0]:.4g}"
    )
