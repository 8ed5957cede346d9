from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benches.data.codec import bench
from benches.data.codec.baselines import Baseline, baselines
from benches.data.codec.bench import DEFAULT, bench_codec
from benches.data.codec.figure import draw_codec
from folders import ROOT
from pictures import decoded, marks

pytest.importorskip("imagecodecs")
pytest.importorskip("numba")


@pytest.fixture(scope="module")
def figures() -> dict[str, Any]:
    return bench_codec(views=1)


@pytest.mark.parametrize("baseline", baselines(), ids=lambda baseline: baseline.name)
def test_every_baseline_is_lossless(baseline: Baseline) -> None:
    """Else its bytes would say nothing."""
    generator = np.random.default_rng(0)
    slope = (21_000 + np.add.outer(np.arange(40) * 7, np.arange(33) * 3)).astype(np.uint16)
    framed = np.zeros((64, 51), np.uint16)
    framed[9:49, 5:38] = slope
    noise = generator.integers(0, 65536, (33, 17)).astype(np.uint16)
    labels = np.where(framed > 0, framed // 700, 255).astype(np.uint8)
    for image, background in ((framed, 0), (noise, 0), (labels, 255)):
        decoded = baseline.decode(baseline.encode(image, background))
        assert decoded.dtype == image.dtype and np.array_equal(decoded, image)


def test_the_default_is_on_the_front_and_small_enough(figures: dict[str, Any]) -> None:
    rows = figures["codecs"]
    assert figures["default"] == DEFAULT and {"PNG", "JPEG-LS", "LERC", "bsi, NumPy", DEFAULT} < set(rows)
    for row in rows.values():
        assert set(row) == {"bytes", "encode_ms", "decode_ms", "decode_ms_without_projector", "images"}
        assert row["bytes"] == sum(image["bytes"] for image in row["images"].values()) and row["decode_ms"] > 0
    assert rows[DEFAULT]["bytes"] == rows["bsi, NumPy"]["bytes"] < 50_000
    assert rows[DEFAULT]["bytes"] < min(rows[name]["bytes"] for name in ("PNG", "JPEG-LS", "two-way, bytes, zstd 1"))
    assert DEFAULT in figures["front"] and figures["front"] == sorted(
        figures["front"], key=lambda name: rows[name]["bytes"]
    )
    assert figures["png_sets"]["five_png_sets_a_sample"] > 5 * figures["png_sets"]["in_the_tar_a_sample"]
    assert figures["projector"]["pixels_in_another_light"] == 0 and figures["projector"]["bytes_saved"] > 0


def test_the_stored_front_is_still_measured() -> None:
    kept = json.loads((ROOT / "docs" / "results" / "codec.json").read_text())
    assert set(kept["front"]) <= {DEFAULT, *(baseline.name for baseline in baselines())} <= set(kept["codecs"])


def test_a_codec_that_loses_anything_stops_the_bench(monkeypatch: pytest.MonkeyPatch) -> None:
    lossy = Baseline("lossy", lambda image, background: b"", lambda data: np.zeros((640, 329), np.uint16))
    monkeypatch.setattr(bench, "baselines", lambda: [lossy])
    with pytest.raises(AssertionError, match="lossy is not lossless"):
        bench_codec(views=1)


def test_the_chart_is_drawn(figures: dict[str, Any], tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    draw_codec(figures, tmp_path / "codec.png")
    picture = decoded(tmp_path / "codec.png")
    ours, others = marks(picture, "#1f5ac8", 80), marks(picture, "#77777f", 30)
    assert len(ours) == sum(name.startswith("bsi") for name in figures["codecs"]) and len(others) > 5
    largest = max(figures["codecs"].values(), key=lambda row: row["bytes"])
    assert largest not in [figures["codecs"][name] for name in figures["codecs"] if name.startswith("bsi")]
    assert min(mark.top for mark in others) < min(mark.top for mark in ours), "more bytes stand higher"
