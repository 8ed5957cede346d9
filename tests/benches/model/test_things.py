"""`bench things`: the fit of the score, and what the bench writes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from benches.model.things import bench
from benches.model.things.bench import RIDGE, bench_things, cross_scores, logistic_fit

from bodyseg_model.segmentation.people.person_score import FEATURES, score_from_json
from bodyseg_model.segmentation.people.shape_network import shipped_shape_network


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
    features = draws.normal(size=(120, len(FEATURES))) + person[:, None]
    features[:, 0] *= 4
    seen = bench.Surfaces(features, person, np.arange(120))
    monkeypatch.setattr(bench, "seen_surfaces", lambda network, count, progress: seen)
    monkeypatch.setattr(bench, "people_and_things", lambda network, score, count, progress: {"rooms": count})
    figures = bench_things(views=50)
    assert figures["test"] == {"rooms": 40}
    assert figures["score"]["source"]["people"] == person.sum()
    shapes = shipped_shape_network()
    parts, shape = (score_from_json(figures["score"]["models"][model], shapes) for model in ("parts", "shape"))
    assert (parts.model, shape.model) == ("parts", "shape") and 0 < shape.cutoff < 1
    assert 0 < parts.thing_below <= parts.cutoff < 1 and parts.thing_below <= shapes.thing_below
    found = figures["cross_validation"]
    told = 1 / (1 + np.exp(-features[:, 0])) < parts.thing_below
    assert found["told before the network"]["people_lost"] == pytest.approx(told[person].mean(), abs=1e-4)
    assert found["told before the network"]["things_kept"] == pytest.approx(1 - told[~person].mean(), abs=1e-4)
    for model in ("parts", "shape"):
        assert found[model]["people_lost"] <= 0.03 and 0 <= found[model]["things_kept"] <= 1
    assert found["parts"]["things_kept"] < 0.2
