"""`bench things`: the fit of the score, and what the bench writes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from benches.model.things import bench
from benches.model.things.bench import RIDGE, bench_things, cross_scores, logistic_fit

from bodyseg_model.segmentation.people.features import PART_FEATURES, SHAPE_FEATURES
from bodyseg_model.segmentation.people.person_score import score_from_json


def clouds(count: int = 400) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    draws = np.random.default_rng(3)
    person = draws.random(count) < 0.4
    features = draws.normal(size=(count, 3)) * (1, 5, 0.1) + np.where(person[:, None], (1.5, 2.0, 0), 0) + (0, 100, 7)
    return features, person


def test_a_fit_is_where_the_penalised_likelihood_is_flat() -> None:
    features, person = clouds()
    weights, bias = logistic_fit(features, person)
    likely = 1 / (1 + np.exp(-(features @ weights + bias)))
    spread = features.std(axis=0)
    standard = (features - features.mean(axis=0)) / spread
    np.testing.assert_allclose(standard.T @ (person - likely), RIDGE * weights * spread, atol=1e-5)
    assert (person - likely).sum() == pytest.approx(0, abs=1e-5)
    assert ((likely > 0.5) == person).mean() > 0.75


def test_a_feature_that_never_changes_has_no_weight() -> None:
    features, person = clouds()
    features[:, 2] = 4.0
    weights, _ = logistic_fit(features, person)
    assert weights[2] == pytest.approx(0, abs=1e-9) and np.isfinite(weights).all()


def test_cross_scores_come_from_other_rooms() -> None:
    features, person = clouds()
    room = np.arange(len(person)) // 4
    found = cross_scores(features, person, room)
    held = room % 5 == 2
    weights, bias = logistic_fit(features[~held], person[~held])
    np.testing.assert_allclose(found[held], 1 / (1 + np.exp(-(features[held] @ weights + bias))))
    assert ((found > 0.5) == person).mean() > 0.75


def test_what_the_bench_writes(monkeypatch: pytest.MonkeyPatch) -> None:
    draws = np.random.default_rng(0)
    person = draws.random(120) < 0.5
    features = {
        "parts": draws.normal(size=(120, len(SHAPE_FEATURES) + len(PART_FEATURES))) + person[:, None],
        "shape": draws.normal(size=(120, len(SHAPE_FEATURES))) + person[:, None],
    }
    seen = bench.Surfaces(features, person, np.arange(120))  # type: ignore[arg-type]
    monkeypatch.setattr(bench, "seen_surfaces", lambda network, count, progress: seen)
    monkeypatch.setattr(bench, "people_and_things", lambda network, score, count, progress: {"rooms": count})
    figures = bench_things(views=50)
    assert figures["test"] == {"rooms": 10}
    assert figures["score"]["source"]["people"] == person.sum()
    validated = dict(figures["cross_validation"])
    first = score_from_json("parts", figures["score"]["models"]["parts"]).first
    assert first is not None and 0 < first.cutoff < 0.5
    told = validated.pop("told by shape")
    assert told["people"] <= 2 and 0 < told["things"] < 1, "people only whom the score loses, too"
    for model, quality in validated.items():
        score = score_from_json(model, figures["score"]["models"][model])
        assert quality["people_lost"] <= 0.04 and 0 <= quality["things_kept"] < 0.5 and 0 < score.cutoff < 1
