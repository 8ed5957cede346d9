"""`bench limits`: the fit of limits between people and things, and what is counted with them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benches.model.things import limits as bench
from benches.model.things.limits import Judged, Plan, bench_limits, curve, fitted, quality, real
from benches.model.things.limits_figure import draw_limits
from benches.model.things.rooms import OTHER_KINDS, Rooms
from fakes import Figures
from folders import ROOT
from label_networks import Places
from PIL import Image

from bodyseg_data.artifacts import Augmentation, load_sensor_model
from bodyseg_data.core import BadConfig, Draws
from bodyseg_data.packing import Numbers
from bodyseg_data.rigs import load_rig
from bodyseg_model.networks import Trained
from bodyseg_model.segmentation import shipped_score


def surfaces(count: int = 400, seed: int = 0) -> Judged:
    """Half people, of whom the network is sure, half things, some of which have a person's shape."""
    draws = np.random.default_rng(seed)
    person = np.arange(count) % 2 == 0
    odds = np.where(person, draws.normal(5, 2, count), draws.normal(-1, 5, count))
    confidence = np.clip(np.where(person, draws.normal(0.8, 0.06, count), draws.normal(0.4, 0.08, count)), 0.1, 0.95)
    sensor = np.array(["one", "other"])[np.arange(count) // 2 % 2]
    return Judged(odds, np.full(count, 0.01), confidence, np.full(count, 0.5), person.astype(float), sensor)


def test_both_tell_more_than_either() -> None:
    fit, test = surfaces(), surfaces(seed=1)
    kept = {}
    for way in bench.WAYS:
        limit = fitted(fit, way)
        assert quality(limit, fit)["people_lost"] in (7, 8), "4 % of 200"
        found = quality(limit, test)
        assert (found["people"], found["things"]) == (200, 200) and found["people_lost"] <= 20, way
        kept[way] = found["things_kept"]
    assert kept["both"] <= kept["confidence"] < kept["shape"]
    assert quality(limit, test, test.sensor == "one")["people"] == 100
    line = curve("both", test, 20)
    assert line["recall"][0] == 1.0 and np.all(np.diff(line["recall"]) <= 0) and line["precision"][-1] == 1.0


def test_nothing_is_fitted_to_things_alone() -> None:
    found = surfaces()
    nobody = Judged(*(getattr(found, name)[1::2] for name in Judged.__dataclass_fields__))
    with pytest.raises(BadConfig, match="^the rooms to fit to show nobody: give bench limits more --views$"):
        fitted(nobody)


def test_kinds_are_closed_solids_on_the_floor() -> None:
    for name, kind in OTHER_KINDS.items():
        solid = kind(Numbers(Draws(0, 0, name), "room"))
        low, high = solid.vertices.min(axis=0), solid.vertices.max(axis=0)
        assert low[1] > -0.5 and 0.3 < high[1] < 2.6 and (high - low).max() < 2.6, name
        assert solid.faces.min() >= 0 and solid.faces.max() < len(solid.vertices), name


def test_artifacts_of_a_sensor_fall_on_rooms() -> None:
    source, rig = Figures(), load_rig("paper")
    sensor = Augmentation(rig, "all", 3, load_sensor_model())
    clean = Augmentation(rig, "none", 3, load_sensor_model())
    seen, plain = (
        Rooms(source, source.bodies(), rig.camera, 3, parts=False, kinds={}, sensor=each) for each in (sensor, clean)
    )
    number = next(number for number in range(20) if (plain(number).person >= 0).sum() > 2000)
    first, again, other, whole = seen(number), seen(number), seen(number, 1), plain(number)
    np.testing.assert_array_equal(first.range_m, again.range_m)
    assert not np.array_equal(first.range_m, other.range_m)
    assert ((whole.range_m > 0) == (whole.person >= 0)).all(), "without kinds of things there is no room"
    assert 0 < (first.range_m > 0).sum() < (whole.range_m > 0).sum(), "shadows"
    assert (first.person[first.range_m == 0] == -1).all()


def test_precision_in_real_frames(tmp_path: Path) -> None:
    depth, mask = np.zeros((480, 640), np.uint16), np.zeros((480, 640), np.bool_)
    depth[100:300, 100:180] = depth[100:300, 400:480] = 2000
    mask[100:260, 100:180] = True
    Image.fromarray(depth).save(tmp_path / "000_depth.png")
    Image.fromarray(mask).save(tmp_path / "000_person.png")
    trained = Trained(Places(0, 50), {})
    found = real(trained, 0.5, tmp_path)
    assert found["frames"] == 1
    assert found["every surface"] == {"surfaces": 2, "precision": 0.5, "recall": 1.0}
    assert found["shape"] == {"surfaces": 0, "precision": None, "recall": 0.0}, "boards are no people"


def test_what_the_bench_writes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[Any, ...]] = []

    def judged(network: Any, plans: tuple[Plan, ...], count: int, seed: int, progress: Any) -> Judged:
        asked.append((network, plans, count, seed))
        return surfaces(seed=seed)

    monkeypatch.setattr(bench, "judged", judged)
    figures = bench_limits(views=7)
    assert asked == [(None, bench.FIT, 7, bench.SEEDS[0]), (None, bench.TEST, 7, bench.SEEDS[1])]
    assert not {*bench.FIT} & {*bench.TEST} and list(figures["sensors"]) == ["one", "other"]
    assert shipped_score(figures).cutoff == figures["least_confidence_of_people"] > 0.5
    draw_limits(figures, tmp_path / "limits.png")
    assert (tmp_path / "limits.png").stat().st_size > 5000


def test_the_limit_that_ships_is_that_of_the_result() -> None:
    figures = json.loads((ROOT / "docs" / "results" / "limits.json").read_text())
    assert shipped_score().cutoff == figures["least_confidence_of_people"]
    assert figures["ways"]["both"]["people_lost"] <= figures["ways"]["both"]["people"] / 200
