"""Baselines of the diagnosis: ways of choosing columns of a library by regression alone.

The methods are those of scikit-learn and pysindy. Each takes the same columns and targets, from
which what the base model's own parameters can do has been taken out, and returns one coefficient
per column, 0 where the column is not chosen. Penalties and thresholds are chosen by
cross-validation over clusters, or by an information criterion. Forward selection and orthogonal
matching pursuit are not among them: scikit-learn's always choose a column, also where there is
nothing.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np

#: Folds of cross-validation; fewer where there are fewer clusters.
_FOLDS = 5
#: Sweeps of coordinate descent in which LASSO converges on columns that are nearly collinear.
_SWEEPS = 20_000
#: Thresholds in shares of the target's norm, from nothing chosen to 10⁻⁵ of the variance; ties go
#: to the first. The weights of ridge are pysindy's own and one for columns that are nearly
#: collinear, whose coefficients would all stay above any threshold.
_THRESHOLDS = np.geomspace(0.3, 0.003, 9)
_RIDGES = (0.05, 0.5)
#: Columns with a smaller share of their own norm left are the base model's.
_OWN = 1e-8


class Library:
    """Columns to choose from.

    Args:
        columns: ``(n, p)``.
        target: ``(n,)`` what they are to explain.
        base: ``(n, K)`` what the base model's own parameters can do.
        cluster: ``(n,)`` number of each row's cluster.

    Attributes:
        x: ``(n, q)`` columns of length 1 without what the base model can do, where any is left.
        y: ``(n,)`` the same of the target.
    """

    def __init__(
        self, columns: np.ndarray, target: np.ndarray, base: np.ndarray, cluster: np.ndarray
    ) -> None:
        self.columns, self.target, self.base, self.cluster = columns, target, base, cluster
        basis = np.linalg.svd(base, full_matrices=False)[0]
        x = columns - basis @ (basis.T @ columns)
        y = target - basis @ (basis.T @ target)
        norm, length = np.linalg.norm(x, axis=0), np.linalg.norm(y)
        self.usable = norm > _OWN * np.linalg.norm(columns, axis=0)
        self.x, self.y = x[:, self.usable] / norm[self.usable], y / length
        self.scale = length / norm[self.usable]

    def folds(self, seed: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """Rows to fit and rows to predict; each cluster is predicted once, as a whole."""
        from sklearn.model_selection import GroupKFold

        number = min(_FOLDS, len(np.unique(self.cluster)))
        folds = GroupKFold(number, shuffle=True, random_state=seed)
        return list(folds.split(self.x, self.y, self.cluster))

    def unscaled(self, theta: np.ndarray) -> np.ndarray:
        """``(p,)`` coefficients of the columns as they were given."""
        unscaled = np.zeros(len(self.usable))
        unscaled[self.usable] = theta * self.scale
        return unscaled


def lasso(library: Library, seed: int) -> np.ndarray:
    """scikit-learn's LASSO (Tibshirani 1996), its penalty by cross-validation over clusters."""
    from sklearn.linear_model import LassoCV

    fit = LassoCV(cv=library.folds(seed), fit_intercept=False, max_iter=_SWEEPS)
    return library.unscaled(fit.fit(library.x, library.y).coef_)


def lasso_bic(library: Library, seed: int) -> np.ndarray:
    """scikit-learn's LASSO, its penalty by the Bayesian information criterion.

    The criterion takes rows as independent (Zou, Hastie & Tibshirani 2007).
    """
    from sklearn.linear_model import LassoLarsIC

    fit = LassoLarsIC("bic", fit_intercept=False)
    root = np.sqrt(len(library.y))  # penalties would else be so small that the path is cut
    with warnings.catch_warnings():
        # a column that others make up is dropped
        warnings.filterwarnings("ignore", "Regressors in active set degenerate")
        theta = fit.fit(root * library.x, root * library.y).coef_
    return library.unscaled(theta)


def ensemble_sindy(library: Library, seed: int) -> np.ndarray:
    """pysindy's ensemble of sequentially thresholded least squares (Fasel et al. 2022).

    Threshold and weight of ridge come from cross-validation over clusters. Members differ by the
    rows they draw, not by clusters: pysindy resamples rows as if they were independent. Their
    median is returned, pysindy's default: a column counts where most members choose it.
    """
    from pysindy.optimizers import STLSQ, EnsembleOptimizer
    from sklearn.model_selection import GridSearchCV
    from sklearn.pipeline import Pipeline

    # STLSQ starts with all columns whatever the guess; one saves a decomposition per fit
    one = STLSQ(initial_guess=np.zeros((1, library.x.shape[1])))
    # within a pipeline, as STLSQ.set_params returns nothing (pysindy 2.1)
    search = GridSearchCV(
        Pipeline([("stlsq", one)]),
        {"stlsq__threshold": _THRESHOLDS, "stlsq__alpha": _RIDGES},
        scoring="neg_mean_squared_error",
        cv=library.folds(seed),
        error_score="raise",
    )
    state = np.random.get_state()
    np.random.seed(seed % 2**32)  # pysindy draws from NumPy's global generator
    try:
        with warnings.catch_warnings():
            # it may choose nothing
            warnings.filterwarnings("ignore", "Sparsity parameter is too big")
            best = search.fit(library.x, library.y).best_estimator_.named_steps["stlsq"]
            ensemble = EnsembleOptimizer(best, bagging=True).fit(library.x, library.y)
    finally:
        np.random.set_state(state)
    return library.unscaled(ensemble.coef_[0])


#: Baselines by name; the first one only recalibrates the base model.
BASELINES: dict[str, Callable[[Library, int], np.ndarray]] = {
    "recalibration": lambda library, seed: np.zeros(library.columns.shape[1]),
    "lasso": lasso,
    "lasso_bic": lasso_bic,
    "ensemble_sindy": ensemble_sindy,
}
