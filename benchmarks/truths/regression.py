"""Peers of the diagnosis: ways of choosing columns of a library by regression alone.

Each takes the same columns and targets, from which what the base model's own parameters can do
has been taken out, and returns one coefficient per column, 0 where the column is not chosen.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numba import njit

#: Penalties of LASSO, relative to the one that leaves nothing; and of ridge, to the mean square.
_PENALTIES = np.geomspace(1.0, 1e-3, 25)
_RIDGES = np.geomspace(1e2, 1e-6, 17)
_FOLDS = 5
#: Coordinate descent ends after so many sweeps, or when no coefficient moves by more.
_SWEEPS, _STILL = 200, 1e-6
#: Members of an ensemble, share of them that have to choose a column, rounds of thresholding.
_MEMBERS, _AGREE, _THRESHOLDINGS = 40, 0.6, 10
#: Thresholds that cross-validation chooses from, in shares of the target's norm.
_THRESHOLDS = (0.01, 0.02, 0.05, 0.1, 0.2)
_STLSQ_RIDGE = 1e-6
#: Columns with a smaller share of their own norm left are the base model's.
_OWN = 1e-8
#: Columns that forward selection takes at most.
_MOST = 12
#: Normal quantile of intervals of 95 %.
_Z = 1.96


@dataclass(frozen=True)
class Library:
    """Columns to choose from; all sums of products by sequence are at hand.

    Args:
        columns: ``(n, p)``.
        target: ``(n,)`` what they are to explain.
        base: ``(n, K)`` what the base model's own parameters can do.
        sequence: ``(n,)`` number of each row's sequence.
    """

    columns: np.ndarray
    target: np.ndarray
    base: np.ndarray
    sequence: np.ndarray
    scale: np.ndarray = field(init=False)
    grams: np.ndarray = field(init=False)
    products: np.ndarray = field(init=False)
    squares: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        basis = np.linalg.svd(self.base, full_matrices=False)[0]
        x = self.columns - basis @ (basis.T @ self.columns)
        y = self.target - basis @ (basis.T @ self.target)
        norm, before = np.linalg.norm(x, axis=0), np.linalg.norm(self.columns, axis=0)
        norm = np.where(norm > _OWN * before, norm, np.inf)
        x = x / norm
        parts = [np.flatnonzero(self.sequence == s) for s in np.unique(self.sequence)]
        object.__setattr__(self, "scale", norm)
        object.__setattr__(self, "grams", np.array([x[i].T @ x[i] for i in parts]))
        object.__setattr__(self, "products", np.array([x[i].T @ y[i] for i in parts]))
        object.__setattr__(self, "squares", np.array([y[i] @ y[i] for i in parts]))

    def sums(self, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Gram matrix, products with the target and its square, sequences weighted."""
        gram = np.tensordot(weight, self.grams, 1)
        return gram, weight @ self.products, float(weight @ self.squares)

    @property
    def everything(self) -> tuple[np.ndarray, np.ndarray, float]:
        """The same of all sequences."""
        return self.sums(np.ones(len(self.grams)))

    def cross_validated(
        self, fits: Callable[[np.ndarray, np.ndarray, float], np.ndarray], seed: int
    ) -> int:
        """Which of several fits predicts sequences best that it has not seen.

        Args:
            fits: of sums to ``(m, p)`` coefficients.
        """
        number = len(self.grams)
        fold = np.random.default_rng(seed).permutation(number) % min(_FOLDS, number)
        error: np.ndarray | float = 0.0
        for f in np.unique(fold):
            theta = fits(*self.sums((fold != f).astype(float)))
            gram, product, square = self.sums((fold == f).astype(float))
            error = error + square - 2 * theta @ product + ((theta @ gram) * theta).sum(1)
        return int(np.argmin(error))


def nothing(library: Library, seed: int) -> np.ndarray:
    """Recalibration of the base model alone."""
    return np.zeros(library.columns.shape[1])


def forward_bic(library: Library, seed: int) -> np.ndarray:
    """Forward selection while the Bayesian information criterion falls (Schwarz 1978)."""
    gram, product, square = library.everything
    n = len(library.target)
    chosen: list[int] = []
    theta, left = np.zeros(len(product)), square
    while len(chosen) < _MOST:
        best, value, now = -1, left, np.empty(0)
        for j in np.flatnonzero(np.isfinite(library.scale)):
            if j in chosen:
                continue
            own = [*chosen, int(j)]
            part = np.linalg.lstsq(gram[np.ix_(own, own)], product[own], rcond=1e-10)[0]
            rest = square - float(part @ product[own])
            if rest < value:
                best, value, now = int(j), rest, part
        if best < 0 or n * np.log(max(value, 1e-300) / left) + np.log(n) >= 0:
            break
        chosen.append(best)
        left, theta = value, np.zeros(len(product))
        theta[chosen] = now
    return theta / library.scale


def lasso(library: Library, seed: int) -> np.ndarray:
    """LASSO (Tibshirani 1996), its penalty by cross-validation over sequences."""

    def fits(gram: np.ndarray, product: np.ndarray, square: float) -> np.ndarray:
        return lasso_path(gram, product, np.abs(product).max() * _PENALTIES)

    best = library.cross_validated(fits, seed)
    found: np.ndarray = fits(*library.everything)[best] / library.scale
    return found


@njit(cache=True)
def lasso_path(gram: np.ndarray, product: np.ndarray, penalties: np.ndarray) -> np.ndarray:
    """``(m, p)`` minima of |y - X theta|²/2 + penalty |theta|₁ by coordinate descent."""
    number = len(product)
    found = np.zeros((len(penalties), number))
    theta = np.zeros(number)
    slope = product.copy()
    for m in range(len(penalties)):
        for _ in range(_SWEEPS):
            moved = 0.0
            for j in range(number):
                if gram[j, j] <= 0.0:
                    continue
                pull = slope[j] + gram[j, j] * theta[j]
                new = max(abs(pull) - penalties[m], 0.0) / gram[j, j]
                if pull < 0.0:
                    new = -new
                change = new - theta[j]
                if change != 0.0:
                    slope -= change * gram[:, j]
                    theta[j] = new
                    moved = max(moved, abs(change))
            if moved <= _STILL * max(np.abs(theta).max(), 1e-300):
                break
        found[m] = theta
    return found


def _thresholded(
    gram: np.ndarray, product: np.ndarray, square: float, threshold: float
) -> np.ndarray:
    """Ridge regression and hard thresholding in turns."""
    keep = np.diag(gram) > 0
    theta = np.zeros(len(product))
    for _ in range(_THRESHOLDINGS):
        own = np.flatnonzero(keep)
        theta[:] = 0
        if not len(own):
            break
        damped = gram[np.ix_(own, own)] + _STLSQ_RIDGE * np.eye(len(own))
        theta[own] = np.linalg.solve(damped, product[own])
        new = np.abs(theta) >= threshold * np.sqrt(square)
        if (new == keep).all():
            break
        keep = new
    return theta


def ensemble_stlsq(library: Library, seed: int) -> np.ndarray:
    """Sequentially thresholded least squares, sequences resampled (Fasel et al. 2022).

    The threshold comes from cross-validation; a column counts where most members choose it, with
    its median.
    """

    def fits(gram: np.ndarray, product: np.ndarray, square: float) -> np.ndarray:
        return np.array([_thresholded(gram, product, square, t) for t in _THRESHOLDS])

    threshold = _THRESHOLDS[library.cross_validated(fits, seed)]
    rng = np.random.default_rng(seed)
    number = len(library.grams)
    members = np.array(
        [
            _thresholded(*library.sums(np.bincount(draw, minlength=number) * 1.0), threshold)
            for draw in rng.integers(number, size=(_MEMBERS, number))
        ]
    )
    agreed = (members != 0).mean(0) >= _AGREE
    found: np.ndarray = np.where(agreed, np.median(members, axis=0), 0.0) / library.scale
    return found


def ridge(library: Library, seed: int) -> np.ndarray:
    """Everything at once by ridge regression, its penalty by cross-validation.

    A column counts where its coefficient's interval of 95 % for independent errors excludes 0.
    """

    def fits(gram: np.ndarray, product: np.ndarray, square: float) -> np.ndarray:
        eye = np.eye(len(product))
        return np.array([np.linalg.solve(gram + r * eye, product) for r in _RIDGES])

    gram, product, square = library.everything
    best = library.cross_validated(fits, seed)
    theta = fits(gram, product, square)[best]
    inverse = np.linalg.inv(gram + _RIDGES[best] * np.eye(len(product)))
    left = max(square - 2 * theta @ product + theta @ gram @ theta, 0.0)
    error = np.sqrt(left / len(library.target) * np.maximum(np.diag(inverse @ gram @ inverse), 0))
    found: np.ndarray = np.where(np.abs(theta) > _Z * error, theta, 0.0) / library.scale
    return found


#: Peers by name.
PEERS: dict[str, Callable[[Library, int], np.ndarray]] = {
    "recalibration": nothing,
    "forward_bic": forward_bic,
    "lasso": lasso,
    "ensemble_stlsq": ensemble_stlsq,
    "ridge": ridge,
}
