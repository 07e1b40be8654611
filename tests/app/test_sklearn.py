"""The Calibrator with scikit-learn's tools, and scikit-learn's checks of estimators."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import nnode
from nnode.errors import NotFittedError
from nnode.model import Traffic, make_law
from tests.app.following import table

pytest.importorskip("sklearn")
from sklearn.base import clone
from sklearn.exceptions import NotFittedError as SklearnNotFittedError
from sklearn.model_selection import GridSearchCV, GroupKFold, cross_val_score
from sklearn.utils import InputTags, Tags, TargetTags
from sklearn.utils.estimator_checks import check_estimator
from sklearn.utils.validation import check_is_fitted

#: The check fits a numeric matrix.
MATRIX = "fits a matrix of numbers, and a Calibrator takes trajectories"
#: The same property is tested with trajectories.
OURS = f"{MATRIX}; tested with trajectories in test_estimator.py"

#: Checks that do not apply, with reasons. All others must pass.
NOT_APPLICABLE = {
    "check_fit_score_takes_y": OURS,
    "check_estimators_overwrite_params": OURS,
    "check_dont_overwrite_parameters": OURS,
    "check_estimators_fit_returns_self": OURS,
    "check_readonly_memmap_input": MATRIX,
    "check_n_features_in_after_fitting": "trajectories have no number of features",
    "check_n_features_in": "trajectories have no number of features",
    "check_positive_only_tag_during_fit": MATRIX,
    "check_estimators_dtypes": MATRIX,
    "check_complex_data": MATRIX,
    "check_dtype_object": MATRIX,
    "check_estimators_empty_data_messages": "errors are NNodeErrors, which say what to do",
    "check_pipeline_consistency": MATRIX,
    "check_estimators_nan_inf": "errors are NNodeErrors, which name the row",
    "check_estimator_sparse_tag": MATRIX,
    "check_estimator_sparse_array": MATRIX,
    "check_estimator_sparse_matrix": MATRIX,
    "check_estimators_pickle": OURS,
    "check_f_contiguous_array_estimator": MATRIX,
    "check_methods_sample_order_invariance": OURS,
    "check_methods_subset_invariance": OURS,
    "check_fit2d_1sample": MATRIX,
    "check_fit2d_1feature": MATRIX,
    "check_dict_unchanged": OURS,
    "check_fit_idempotent": OURS,
    "check_fit_check_is_fitted": OURS,
    "check_fit1d": MATRIX,
    "check_fit2d_predict1d": MATRIX,
}


@pytest.fixture(scope="module")
def sequences() -> nnode.Sequences:
    return nnode.sequences(table(platoons=6, seconds=8.0))


class _MatrixCalibrator(nnode.Calibrator):
    """Declares matrix input; otherwise scikit-learn skips nearly all checks."""

    def __sklearn_tags__(self) -> Any:
        return Tags(
            estimator_type=None, target_tags=TargetTags(required=False), input_tags=InputTags()
        )


@pytest.mark.filterwarnings("ignore")
def test_applicable_scikit_learn_checks_pass() -> None:
    result = check_estimator(_MatrixCalibrator(), on_fail=None, on_skip=None)
    failed = {row["check_name"] for row in result if row["status"] == "failed"}
    passed = {row["check_name"] for row in result if row["status"] == "passed"}
    assert failed == set(NOT_APPLICABLE), [r["exception"] for r in result if r["exception"]]
    assert {
        "check_estimator_cloneable",
        "check_get_params_invariance",
        "check_set_params",
        "check_no_attributes_set_in_init",
        "check_parameters_default_constructible",
        "check_estimators_unfitted",
        "check_estimator_repr",
        "check_valid_tag_types",
    } <= passed


def test_clone_is_unfitted(sequences: nnode.Sequences) -> None:
    fitted = nnode.Calibrator("lin", effects=({"name": "inertia"},), epochs=1).fit(sequences)
    copied = clone(fitted)
    assert copied.get_params() == fitted.get_params()
    check_is_fitted(fitted)
    for kind in (NotFittedError, SklearnNotFittedError):
        with pytest.raises(kind):
            copied.predict(sequences)
    with pytest.raises(SklearnNotFittedError):
        check_is_fitted(copied)


def test_clone_copies_a_model_s_values() -> None:
    calibrator = nnode.Calibrator(Traffic([make_law("lin", v0=21.0, L=4.0)], leader="measured"))
    copied = clone(calibrator)
    assert copied.model is not calibrator.model
    assert float(copied.model.physical()["lin.v0"][0]) == pytest.approx(21.0)


def test_cross_validation_by_clusters(sequences: nnode.Sequences) -> None:
    calibrator = nnode.Calibrator("idm", epochs=3, drivers="none")
    folds = GroupKFold(2)
    scores = cross_val_score(calibrator, sequences, groups=sequences.groups, cv=folds)
    assert (scores < 0).all()
    expected = []
    for train, test in folds.split(sequences, groups=sequences.groups):
        assert not set(sequences.groups[train]) & set(sequences.groups[test])
        expected.append(clone(calibrator).fit(sequences[train]).score(sequences[test]))
    assert scores == pytest.approx(np.array(expected), rel=1e-12)


def test_sequences_with_a_common_vehicle_are_one_group() -> None:
    data = table(platoons=4, seconds=3.0)
    data.loc[(data.sequence == 1) & (data.agent == 10), "agent"] = 0
    sequences = nnode.sequences(data, agents="global")
    assert len(sequences) == 4
    assert sequences.groups[0] == sequences.groups[1]
    assert len(set(sequences.groups)) == 3


def test_grid_search_selects_the_true_law(sequences: nnode.Sequences) -> None:
    search = GridSearchCV(
        nnode.Calibrator(leader="measured", epochs=15, drivers="none"),
        {"model": ["lin", "idm"]},
        cv=GroupKFold(2),
    )
    search.fit(sequences, groups=sequences.groups)
    assert search.best_params_ == {"model": "idm"}
    assert search.best_estimator_.parameters_.index[0] == "idm.v0"
    assert search.score(sequences) == search.best_estimator_.score(sequences)
