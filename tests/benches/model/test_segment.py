"""`bench segment`: what it counts, and what it writes and draws."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from benches.model.rooms.made import Made, Who
from benches.model.segment import bench
from benches.model.segment.bench import (
    LIVE,
    ROUNDS,
    STAGES,
    WAYS,
    accuracy,
    bench_segment,
    by_people,
    cameras,
)
from benches.model.segment.figure import _COLOURS, draw_segment
from benches.model.segment.live import Sensor
from label_networks import Places
from pictures import decoded, marks, part
from small_rig import SMALL

from bodyseg_data.labels import BACKGROUND, UNLABELLED
from bodyseg_data.rigs import Camera
from bodyseg_model import runtimes
from bodyseg_model.networks import Trained
from bodyseg_model.runtimes import load_network


def made(camera: Camera) -> Made:
    """Two blocks before a wall: a person with labels 3, and a thing."""
    shape = rows, columns = camera.rows, camera.columns
    range_m, person = np.full(shape, 4.0, np.float32), np.zeros(shape, np.uint8)
    labels, thing = np.full(shape, UNLABELLED, np.uint8), np.zeros(shape, np.uint8)
    block = slice(rows // 6, rows * 5 // 6), slice(columns // 3, columns // 2)
    range_m[block], person[block], labels[block] = 2.0, 1, 3
    beside = block[0], slice(columns * 2 // 3, columns * 3 // 4)
    range_m[beside], thing[beside] = 2.0, 1
    who = (Who("standing", None, "nothing", False),)
    return Made("all kinds", 0, "kinect_v1", camera, range_m, person, thing, labels, who, ("chair",), 1.0, 0.0)


def test_people_found_and_labels_right_are_counted() -> None:
    room = made(Camera(60, 80, 100.0, (40.0, 30.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
    person = room.person > 0
    half = np.where(person & (np.arange(60)[:, None] < 30), 3, BACKGROUND).astype(np.uint8)
    wrong = np.where(room.range_m < 3, 7, BACKGROUND).astype(np.uint8)
    found = accuracy([room, room, room], [np.where(person, room.labels, BACKGROUND), half, wrong], 0.01)
    assert (found["people"], found["found"], found["person_pixels"]) == (3, 3, 3 * person.sum())
    assert found["right"] == 0.5 and found["thing_pixels"] == (room.thing > 0).sum()
    less = np.where(np.arange(60)[:, None] < 28, half, BACKGROUND).astype(np.uint8)
    assert accuracy([room], [less], 0.01)["found"] == 0
    assert accuracy([room], [less], 0.001)["people"] == 0, "too small to count"


def test_a_sensor_gives_the_newest_frame_and_none_twice() -> None:
    frames = [np.full((2, 2), number, np.float32) for number in range(3)]
    sensor = Sensor(frames, count=4, rate=100.0)
    seen = []
    for number, frame in enumerate(sensor):
        seen.append(frame[0, 0])
        assert time.perf_counter() >= sensor.came[number]
        if number == 1:
            time.sleep(0.045)  # four frames pass
    assert seen == [0, 1, 2, 0]
    steps = np.rint(np.diff(sensor.came) * 100)
    assert (steps >= 1).all() and steps[1] >= 4


def test_times_by_people_are_without_the_first_frame_and_without_writing() -> None:
    times = [(1, 900.0, 1.0), (2, 20.0, 5.0), (1, 10.0, 5.0), (2, 31.0, 5.0)]
    each = [{"people": people, "ms": {"read": 1.0, "network": ms, "write": write}} for people, ms, write in times]
    assert by_people(each) == {
        "1": {"mean": 11.0},
        "2": {"mean": 26.5},
    }


def test_the_median_of_a_ways_rounds_counts() -> None:
    rounds = [{"frames_per_second": rate, "ms": 1000 / rate} for rate in (20.0, 50.0, 10.0)]
    assert ROUNDS == 3
    assert bench._of_all(rounds) == {"frames_per_second": 20.0, "ms": 50.0, "rounds": [20.0, 50.0, 10.0]}


def test_the_bench_runs_every_way_and_draws(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, near_is_person: None
) -> None:
    trained = Trained(Places(axis=0, step=5), {"network": "places", "rig": SMALL.to_json()})
    monkeypatch.setattr(runtimes, "load_network", lambda run, dense=False: load_network(run) if run else trained)
    monkeypatch.setattr(bench, "load_network", lambda: trained)
    monkeypatch.setattr(bench, "made_rooms", lambda camera, count: [made(camera)] * count)
    ways_by_torch = {name: way for name, way in WAYS.items() if "backend" not in way.options}
    assert len(ways_by_torch) == len(WAYS) - 3
    monkeypatch.setattr(bench, "WAYS", ways_by_torch)
    live_by_torch = {name: way for name, way in LIVE.items() if way[0] is None}
    assert len(live_by_torch) == len(LIVE) - 1
    monkeypatch.setattr(bench, "LIVE", live_by_torch)
    lens = Camera(60, 80, 65.5, (40.0, 30.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    assert [(camera.rows, camera.columns) for camera in cameras().values()] == [(480, 640), (1024, 1024)]
    monkeypatch.setattr(bench, "cameras", lambda: {"small": lens})
    monkeypatch.setattr(bench, "ROUNDS", 1)
    steps: list[int] = []
    figures = bench_segment(views=1, progress=lambda done, total, note="": steps.append(done))
    assert steps == list(range(1, 2 + len(ways_by_torch)))
    assert figures["default"] in WAYS and set(figures["sizes"]) == {"small"}
    for size in figures["sizes"].values():
        ways = size["ways"]
        assert set(ways) == set(ways_by_torch)
        assert set(size["live"]) == set(live_by_torch)
        for way in (each[order] for each in size["live"].values() for order in ("one by one", "two at once")):
            assert 0 < way["p50_ms"] <= way["p95_ms"] and way["frames_per_second"] > 0
        for way in ways.values():
            assert way["rounds"] == [way["frames_per_second"]]
            assert set(way["ms"]) == {*STAGES, "frame"} and way["people"] == 1
        same = ("float32", "beside a busy program", "no pictures")
        accuracies = [{key: ways[way][key] for key in ("found", "right", "thing_pixels")} for way in same]
        assert all(each == accuracies[0] for each in accuracies), "loops, load and pictures change no label"
        assert ways["things labelled, too"]["found"] == 1 and ways["things labelled, too"]["thing_pixels"] > 0
    draw_segment(figures, tmp_path / "segment.png")
    picture = part(decoded(tmp_path / "segment.png"), across=(0, 0.62), down=(0, 0.9))
    longest = max(
        (way["ms"][stage]["mean"], stage)
        for size in figures["sizes"].values()
        for way in size["ways"].values()
        for stage in STAGES
    )[1]
    bars = {stage: marks(picture, colour, 4) for stage, colour in zip(STAGES, _COLOURS, strict=True)}
    widest = {stage: max((mark.width for mark in found), default=0) for stage, found in bars.items()}
    assert widest[longest] + 2 >= max(widest.values()) > 20, "two stages may be as long"
