"""The Calibrator among scikit-learn's tools, and scikit-learn's own checks of estimators."""

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
from sklearn.exceptions import NotFittedError as TheirNotFittedError
from sklearn.model_selection import GridSearchCV, GroupKFold, cross_val_score
from sklearn.utils import InputTags, Tags, TargetTags
from sklearn.utils.estimator_checks import check_estimator
from sklearn.utils.validation import check_is_fitted

#: Asked of numbers in a matrix, of which trajectories cannot be made.
MATRIX = "fits a matrix of numbers, and a Calibrator takes trajectories"
#: The same property of trajectories is tested in test_estimator.py.
OURS = f"{MATRIX}; tested with trajectories in test_estimator.py"

#: Checks that do not apply, and why. All others must pass.
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


class _OfMatrices(nnode.Calibrator):
    """Says that it takes matrices, as otherwise nearly no check is run."""

    def __sklearn_tags__(self) -> Any:
        return Tags(
            estimator_type=None, target_tags=TargetTags(required=False), input_tags=InputTags()
        )


@pytest.mark.filterwarnings("ignore")
def test_scikit_learn_s_checks_pass_where_they_apply() -> None:
    result = check_estimator(_OfMatrices(), on_fail=None, on_skip=None)
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


def test_a_clone_has_the_parameters_and_no_fit(sequences: nnode.Sequences) -> None:
    fitted = nnode.Calibrator("lin", effects=({"name": "inertia"},), epochs=1).fit(sequences)
    copied = clone(fitted)
    assert copied.get_params() == fitted.get_params()
    check_is_fitted(fitted)
    for kind in (NotFittedError, TheirNotFittedError):
        with pytest.raises(kind):
            copied.predict(sequences)
    with pytest.raises(TheirNotFittedError):
        check_is_fitted(copied)


def test_a_module_is_cloned_with_its_values() -> None:
    own = nnode.Calibrator(Traffic([make_law("lin", v0=21.0, L=4.0)], leader="measured"))
    copied = clone(own)
    assert copied.model is not own.model
    assert float(copied.model.physical()["lin.v0"][0]) == pytest.approx(21.0)


def test_cross_validation_by_clusters_is_the_same_by_hand(sequences: nnode.Sequences) -> None:
    one = nnode.Calibrator("idm", epochs=3, drivers="none")
    folds = GroupKFold(2)
    scores = cross_val_score(one, sequences, groups=sequences.groups, cv=folds)
    assert (scores < 0).all()
    by_hand = []
    for train, test in folds.split(sequences, groups=sequences.groups):
        assert not set(sequences.groups[train]) & set(sequences.groups[test])
        by_hand.append(clone(one).fit(sequences[train]).score(sequences[test]))
    assert scores == pytest.approx(np.array(by_hand), rel=1e-12)


def test_sequences_that_share_a_vehicle_are_one_group() -> None:
    shared = table(platoons=4, seconds=3.0)
    shared.loc[(shared.sequence == 1) & (shared.agent == 10), "agent"] = 0
    kept = nnode.sequences(shared, agents="global")
    assert len(kept) == 4
    assert kept.groups[0] == kept.groups[1]
    assert len(set(kept.groups)) == 3


def test_a_search_over_models_finds_the_law_that_was_driven(sequences: nnode.Sequences) -> None:
    search = GridSearchCV(
        nnode.Calibrator(leader="measured", epochs=15, drivers="none"),
        {"model": ["lin", "idm"]},
        cv=GroupKFold(2),
    )
    search.fit(sequences, groups=sequences.groups)
    assert search.best_params_ == {"model": "idm"}
    assert search.best_estimator_.parameters_.index[0] == "idm.v0"
    assert search.score(sequences) == search.best_estimator_.score(sequences)
