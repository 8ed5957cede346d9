"""`bench windows`: what a network sees of an image through a window, and what the bench writes and draws."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from benches.model.rooms.made import Made, Who
from benches.model.segment import windows as bench
from benches.model.segment.windows import MARGINS, Windowed, bench_windows
from benches.model.segment.windows_figure import draw_windows
from pictures import decoded, marks, part

from bodyseg_data.labels import BACKGROUND
from bodyseg_data.rigs import load_sensor
from bodyseg_model.networks.compact import Compact, CompactSettings


def test_a_window_is_cut_out_and_put_back() -> None:
    torch.manual_seed(3)
    network = Compact(CompactSettings(widths=(8,), blocks=(1,))).eval()
    range_m = torch.zeros(1, 1, 300, 420)
    range_m[:, :, 150:230, 210:260] = 2.5
    with torch.no_grad():
        whole, windowed = network.scores(range_m), Windowed(network, 20)
        scores = windowed.scores(range_m)
        assert scores.shape == whole.shape
        assert torch.equal(scores[:, :, 32:63, 32:70], network.scores(range_m[:, :, 128:250, 128:280]))
        outside = scores.clone()
        outside[:, :, 32:63, 32:70] = 0
        assert not outside.any()
        assert torch.equal(Windowed(network, None).scores(range_m), whole)


def test_margins_are_compared_on_the_set_and_in_rooms(
    small_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, near_is_person: None
) -> None:
    person = np.zeros((480, 640), np.uint8)
    person[100:400, 260:380] = 1
    range_m, labels = (np.where(person, each, none) for each, none in ((np.float32(2.5), 0), (np.uint8(3), BACKGROUND)))
    camera, who = load_sensor("kinect_v1").camera, Who("standing", None, "nothing", False)
    seen = range_m.astype(np.float32), person, 0 * person, labels.astype(np.uint8)
    room = Made("all kinds", 0, "kinect_v1", camera, *seen, (who,), (), 1.0, 0.0)
    monkeypatch.setattr(bench, "made_rooms", lambda camera, count: [room] * count)
    found = bench_windows(str(small_set), views=2, images=3)
    assert [len(found["sets"][name]["margins"]) for name in ("set", "rooms")] == [len(MARGINS)] * 2
    assert (found["sets"]["set"]["bodies"], found["sets"]["rooms"]["bodies"]) == (3, 2)
    for of in found["sets"].values():
        assert (of["margins"][-1]["less"], of["margins"][-1]["less_error"]) == (0, 0)
    for of in found["sets"].values():  # points apart from each other, however long this machine took
        for number, row in enumerate(of["margins"], 1):
            row["ms"], row["right"] = 10.0 * number, 0.1 * number
    draw_windows(found, tmp_path / "windows.png")
    picture = decoded(tmp_path / "windows.png")
    for half in ((0.0, 0.5), (0.5, 1.0)):
        star = max(marks(part(picture, across=half), "#1f4fa8", 60), key=lambda mark: mark.pixels)
        assert star.height > 14, "the whole image is a star"
