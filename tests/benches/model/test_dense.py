"""`bench dense`: distances along the template, and what it counts of a network's answers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from benches.model import dense
from benches.model.dense import along_template, bench_dense, summary
from benches.model.dense_figure import draw_dense
from PIL import Image

from bodyseg_data import RangeImages, load_template
from bodyseg_data.core import BadConfig
from bodyseg_data.labels import BACKGROUND
from bodyseg_data.meshes.geodesics import nearest_sources
from bodyseg_data.samples import ViewGrid
from bodyseg_model.networks import build, save_network
from bodyseg_model.networks.registry import Prediction

_HAND = 21  # label of the right one


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory, pack_figures: Callable[..., Path], quick_geodesics: None) -> Path:
    one_view = ViewGrid(span_deg=360, count=1)
    return pack_figures(tmp_path_factory.mktemp("mapped") / "set", template=True, views=one_view)


def test_distances_follow_the_surface() -> None:
    template = load_template()
    hand = int(np.flatnonzero(template.parts == _HAND)[0])
    others = np.arange(0, len(template.points), 97)
    found = along_template(np.full(len(others), hand), others)
    lines = nearest_sources(
        "unfolded", template.vertices, template.faces.astype(np.int64), template.corners[[hand]].astype(np.int64)
    )
    true = 1000 * lines.distance[template.corners[others]]
    far = np.isfinite(true) & (true > 200)
    assert far.sum() > 50 and 0.97 < np.median(found[far] / true[far]) < 1.03
    assert np.percentile(np.abs(found[far] / true[far] - 1), 95) < 0.12
    straight = 1000 * np.linalg.norm(template.points[others] - template.points[hand], axis=1)
    assert (found > straight - 0.01).all() and (found / straight.clip(1)).max() > 2.5, "from a hand up its arm"
    assert np.array_equal(along_template(others[:5], others[:5]), np.zeros(5))


def test_a_summary_counts_errors_that_are_on_another_part() -> None:
    found = summary(np.array([0.0, 10.0, 20.0, 30.0, 240.0]))
    assert found == {"pairs": 5, "mean": 60.0, "median": 20.0, "p90": 156.0, "far": 0.2}


def test_true_answers_have_no_error_and_a_network_without_places_has_scores_alone(
    mapped: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tiny = {"patch": 16, "widths": [8], "blocks": [0]}
    for name, more in (("with", {"template": True}), ("without", {})):
        (tmp_path / name).mkdir()
        save_network(tmp_path / name / "network.safetensors", build("compact", {**tiny, **more}, 0), "compact", {})
    runs = [tmp_path / "with", tmp_path / "without"]
    images = RangeImages(mapped, "none", "test", planes=["template"])
    true = {item["range"].numpy().tobytes(): item for item in (images[index] for index in range(len(images)))}

    def told(network: object, range_m: torch.Tensor, by_part: bool) -> tuple[Prediction, np.ndarray]:
        clean = true[range_m[0].numpy().tobytes()]
        labels = clean["labels"][None]
        return Prediction(labels, (labels != BACKGROUND).float()), clean["planes"]["template"].numpy()[None]

    monkeypatch.setattr(dense, "VARIANTS", ("none",))
    plain = bench_dense(str(mapped), runs, 2)["networks"]
    assert plain["with"]["open"]["none"]["geodesic_mm"]["median"] > 30 and plain["with"]["times_as_long"] > 0
    monkeypatch.setattr(dense, "predict_dense", told)
    found = bench_dense(str(mapped), runs, 2, str(mapped))
    for of_set in ("open", "hard"):
        figures = found["networks"]["with"][of_set]["none"]
        assert figures["accuracy"] == 1 and figures["images"] == 2
        assert figures["geodesic_mm"]["mean"] == 0 and figures["geodesic_mm"]["pairs"] == 100
        assert found["networks"]["without"][of_set]["none"].keys() == {"images", "accuracy"}
    assert len(found.shown) > 0
    draw_dense(found, tmp_path / "dense.png")
    with Image.open(tmp_path / "dense.png") as picture:
        assert picture.height > 2 * 320, "a row for each set, where all in one row would be tiny on a page"
        colours = np.asarray(picture.convert("RGB")).reshape(-1, 3)
    assert len(np.unique(colours, axis=0)) > 100


def test_a_set_without_the_map_is_refused(small_set: Path) -> None:
    with pytest.raises(BadConfig, match="no map of the body"):
        bench_dense(str(small_set))
