"""Places followed by meshes made by hand, scores counted by hand, and a motion of balls from end to end."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import torch
from benches.charts import stability_tables
from benches.data.occlusion.shadow_rays import lit as lit_by_rays
from benches.model import motion
from benches.model.motion import (
    AZIMUTHS_DEG,
    NEAR_M,
    NOT_SEEN,
    RenderedBody,
    TemporalConsistency,
    Tracks,
    bench_motion,
    choose_shots,
    find_tracks,
    follow,
    motion_over_seeds,
    render_shot,
    temporal,
)
from fakes import Figures
from numpy.typing import NDArray
from shapes import ball, figure
from small_rig import SMALL

from bodyseg_data.artifacts import Augmentation
from bodyseg_data.bodies import Body, BodyRef
from bodyseg_data.core import BadConfig
from bodyseg_data.labels import PART_COUNT
from bodyseg_data.meshes import Mesh, partition
from bodyseg_data.packing import Sampler
from bodyseg_data.rendering import RasterRenderer
from bodyseg_data.rendering.embree import EmbreeRenderer
from bodyseg_data.rigs import Camera, load_rig
from bodyseg_data.samples import View
from bodyseg_model.networks import Network, Trained, build, predict, save_network
from bodyseg_model.stability import Group, Run

RIG = load_rig()
COLUMNS = RIG.camera.columns
Triple = tuple[float, float, float]

_CORNERS = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_SIDES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
_BOX = np.array([face for a, b, c, d in _SIDES for face in ((a, b, c), (a, c, d))])


pytestmark = pytest.mark.usefixtures("one_thread")


def boxes(*sizes_and_middles: tuple[Triple, Triple]) -> Mesh:
    """Boxes along the axes, 12 triangles each."""
    vertices = [_CORNERS * size + middle for size, middle in sizes_and_middles]
    return Mesh("boxes", np.concatenate(vertices), np.concatenate([_BOX + 8 * i for i in range(len(vertices))]))


def seen(mesh: Mesh) -> RenderedBody:
    """From the front, by a camera that stands 2.55 m from the origin, wherever the mesh is."""
    camera, _ = RIG.placed(np.zeros(3), View(255, 0))
    return RenderedBody(mesh, camera, RasterRenderer(mesh).render(camera))


def metres_of(pixels: int, depth_m: float) -> float:
    return pixels * depth_m / RIG.camera.focal_px


def test_each_pixel_follows_itself() -> None:
    body = seen(figure())
    assert len(body.pixels) > 20_000
    np.testing.assert_array_equal(follow(body, body), body.pixels)


@pytest.mark.parametrize(("right", "down"), [(3, 0), (0, -7), (-20, 11)])
def test_whole_pixels_of_movement_are_found_exactly(right: int, down: int) -> None:
    # Of a box around the camera's axis only the front is seen, all of it 2.35 m away.
    size = (0.5, 0.8, 0.4)
    middle = (metres_of(right, 2.35), metres_of(-down, 2.35), 0.0)
    first, later = seen(boxes((size, (0, 0, 0)))), seen(boxes((size, middle)))
    np.testing.assert_array_equal(follow(first, later), first.pixels + down * COLUMNS + right)


def test_what_leaves_the_frame_is_not_seen() -> None:
    first = seen(boxes(((0.5, 0.8, 0.4), (0, 0, 0))))
    later = seen(boxes(((0.5, 0.8, 0.4), (metres_of(120, 2.35), 0, 0))))
    column = first.pixels % COLUMNS + 120
    assert (column >= COLUMNS).any() and (column < COLUMNS).any()
    np.testing.assert_array_equal(
        follow(first, later), np.where(column < COLUMNS, first.pixels + 120, NOT_SEEN), "not on the next row"
    )


def test_nothing_is_seen_of_a_body_that_is_gone() -> None:
    first, gone = seen(boxes(((0.5, 0.8, 0.4), (0, 0, 0)))), seen(boxes(((0.5, 0.8, 0.4), (3, 0, 0))))
    assert not len(gone.pixels)
    assert (follow(first, gone) == NOT_SEEN).all()
    assert follow(gone, first).shape == (0,)


def test_a_limb_in_front_hides_what_is_behind() -> None:
    trunk, limb = ((0.4, 0.8, 0.3), (0.0, 0.0, 0.0)), (0.06, 0.5, 0.1)
    away = metres_of(64, 2.0)  # the limb's front is 2 m from the camera
    first = seen(boxes(trunk, (limb, (-away - 0.1, 0, 0.5))))
    later = seen(boxes(trunk, (limb, (-0.1, 0, 0.5))))
    found = follow(first, later)
    of_trunk = first.faces < 12
    behind = later.surface.face.ravel()[first.pixels] >= 12
    assert 1000 < (of_trunk & behind).sum() < of_trunk.sum() / 2
    np.testing.assert_array_equal(found[of_trunk], np.where(behind, NOT_SEEN, first.pixels)[of_trunk])
    front = first.faces >= 12
    front &= np.isclose(first.surface.range.ravel()[first.pixels], 2.0)
    np.testing.assert_array_equal(found[front], first.pixels[front] + 64)


@pytest.mark.parametrize(("gap_m", "hidden"), [(NEAR_M - 0.001, False), (NEAR_M + 0.001, True)])
def test_a_place_is_seen_by_a_pixel_that_sees_one_near_it(gap_m: float, hidden: bool) -> None:
    trunk, plate = ((0.4, 0.8, 0.3), (0.0, 0.0, 0.0)), (0.2, 0.2, 0.05)
    first = seen(boxes(trunk, (plate, (0.6, 0, 0))))
    later = seen(boxes(trunk, (plate, (0, 0, 0.15 - 0.025 + gap_m))))
    behind = later.surface.face.ravel()[first.pixels] >= 12
    assert behind.sum() > 2000
    # At the plate's rim, lines of sight are not square to it: a pixel more or less.
    assert (follow(first, later)[behind & (first.faces < 12)] == NOT_SEEN).mean() == pytest.approx(
        float(hidden), abs=0.05
    )


def test_what_turns_away_is_not_seen_through_a_thin_body() -> None:
    plate = boxes(((0.4, 0.8, 0.004), (0.0, 0.0, 0.0)))
    turned = replace(plate, vertices=plate.vertices * (-1, 1, -1))  # half a turn about the vertical axis
    first = seen(plate)
    assert (follow(first, seen(turned)) == NOT_SEEN).all()
    assert (follow(first, seen(boxes(((0.4, 0.8, 0.004), (0.0, 0.0, 0.0))))) != NOT_SEEN).all()


def test_a_turned_body_is_followed_where_rays_reach_it() -> None:
    plain = figure()
    angle = np.radians(40)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    first, later = (seen(replace(plain, vertices=(plain.vertices - (0, 0.9, 0)) @ way)) for way in (np.eye(3), turn))
    found = follow(first, later)
    places = first.points @ turn
    kept = found != NOT_SEEN
    column, row = np.floor(later.camera.project(places)[0]).astype(int).T
    np.testing.assert_array_equal(found[kept], (row * COLUMNS + column)[kept])
    reached = lit_by_rays(EmbreeRenderer(later.mesh), places, later.camera.position)
    assert 0.1 < (~reached).mean() < 0.2
    assert kept[~reached].mean() < 0.005
    assert kept[reached].mean() > 0.96, "a pixel's centre may see past an edge"


def test_only_bodies_of_the_same_triangles_can_be_followed() -> None:
    one = seen(boxes(((0.5, 0.8, 0.4), (0, 0, 0))))
    other = seen(Mesh("other", one.mesh.vertices, np.roll(one.mesh.faces, 1, axis=0)))
    with pytest.raises(BadConfig, match="share their triangles can be followed, found boxes and other"):
        follow(one, other)


def test_tracks_of_a_still_body_stay_where_they_are() -> None:
    body = seen(boxes(((0.5, 0.8, 0.4), (0, 0, 0))))
    tracks = find_tracks([body] * 5, 3)
    assert [pairs.shape for pairs in tracks.pairs] == [(2, len(body.pixels))] * 4
    assert [places.shape for places in tracks.windows] == [(3, len(body.pixels))] * 3
    for places in (*tracks.pairs, *tracks.windows):
        assert (places == body.pixels).all()
    images = np.ones((5, 640, COLUMNS), np.bool_)
    images[2].ravel()[body.pixels[:100]] = False
    kept = tracks.measured(images)
    assert [pairs.shape[1] for pairs in kept.pairs] == [len(body.pixels) - lost for lost in (0, 100, 100, 0)]
    assert kept.points() == 3 * (len(body.pixels) - 100), "frame 2 is in every window"


def test_places_that_one_frame_of_a_window_hides_are_not_in_it() -> None:
    trunk, limb = ((0.4, 0.8, 0.3), (0.0, 0.0, 0.0)), (0.06, 0.5, 0.1)
    aside, across = (seen(boxes(trunk, (limb, (x, 0, 0.5)))) for x in (0.3, -0.1))
    windows = find_tracks([aside, across, aside], 3).windows
    hidden = across.surface.face.ravel()[aside.pixels[aside.faces < 12]] >= 12
    assert len(windows) == 1 and hidden.any()
    of_trunk = aside.surface.face.ravel()[windows[0][0]] < 12
    assert of_trunk.sum() == (~hidden).sum()


def test_scores_counted_by_hand() -> None:
    # Three frames of four pixels, of which each place moves one to the right; one window.
    predicted = np.array([[1, 1, 2, 9], [9, 1, 1, 2], [1, 9, 1, 3]], np.uint8)[:, None]
    truth = np.array([[1, 1, 2, 9], [9, 1, 2, 2], [9, 9, 1, 2]], np.uint8)[:, None]
    pairs = [np.array([[0, 1, 2], [1, 2, 3]])] * 2
    windows = [np.array([[0, 1], [1, 2], [2, 3]])]
    tally = TemporalConsistency()
    tally.add(predicted, truth, Tracks(pairs, windows))
    scores = tally.to_json()
    # Pairs (1,1) (1,1) (2,2) and (9,9) (1,1) (1,3): of part 1, 3 of 4; of 2 and 9, all; of 3, none.
    assert scores["tc"] == pytest.approx((3 / 4 + 1 + 1 + 0) / 4)
    # The first place is called 1 1 1 and is 1 1 1; the second 1 1 3 and is 1 2 2.
    assert (scores["vc"], scores["vc_right"]) == (0.5, 0.5)
    assert (scores["vc_where_truth_stays"], scores["vc_right_where_truth_stays"]) == (1.0, 1.0)
    # Part 1: 4 of 4; 2: 2 of 4; 9: 3 of 4.
    assert scores["accuracy"] == pytest.approx((1 + 0.5 + 0.75) / 3, abs=1e-5)
    assert scores["pixel_accuracy"] == 9 / 12
    wrong = TemporalConsistency()
    wrong.add(np.full_like(predicted, 5), truth, Tracks(pairs, windows))
    assert wrong.to_json() | {"accuracy": 0.0} == {
        "tc": 1.0,
        "vc": 1.0,
        "vc_right": 0.0,
        "vc_where_truth_stays": 1.0,
        "vc_right_where_truth_stays": 0.0,
        "accuracy": 0.0,
        "pixel_accuracy": 0.0,
    }, "a label that never changes is steady, and wrong"


def test_a_share_of_nothing_is_null() -> None:
    assert set(TemporalConsistency().to_json().values()) == {None}


class Walk:
    """A motion of seven frames to test on, one of two and one to train on. Balls go to the left, or stand still."""

    name = "open"

    def __init__(self, step_m: float = 0.01) -> None:
        self.step_m = step_m

    def bodies(self) -> Sequence[BodyRef]:
        def posed(name: str, frames: int, split: Literal["train", "test"]) -> list[BodyRef]:
            return [BodyRef("B", "B", f"B-{name}-{number:03d}", name, split) for number in range(frames)]

        return [*posed("walk", 7, "test"), *posed("wave", 2, "test"), *posed("jump", 9, "train")]

    def missing(self) -> Sequence[str]:
        return ()

    def fingerprint(self, bodies: Sequence[BodyRef]) -> str:
        return "walk 1"

    def build(self, body: BodyRef) -> Body:
        mesh = ball(centre=(self.step_m * int(body.mesh[-3:]), 0.9, 0.0), subdivisions=3, name=body.mesh)
        return Body(mesh, np.linspace(0, 640, PART_COUNT).astype(np.int64))


class ByRange(Network):
    """Takes every pixel by itself: its range in centimetres says what it is called."""

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        scores = torch.zeros(len(range_m), PART_COUNT, *range_m.shape[2:])
        return scores.scatter(1, (range_m * 100 % PART_COUNT).long(), 1.0)


class Always(Network):
    """Calls everything the same part."""

    def __init__(self, part: int) -> None:
        super().__init__()
        self.part = part

    def scores(self, range_m: torch.Tensor) -> torch.Tensor:
        scores = torch.zeros(len(range_m), PART_COUNT, *range_m.shape[2:])
        scores[:, self.part] = 1
        return scores


def test_shots_lie_evenly_along_motions_to_test_on() -> None:
    shots = choose_shots(Walk(), 3, 2)
    assert [[body.mesh for body in shot.bodies] for shot in shots] == [
        ["B-walk-001", "B-walk-002"],
        ["B-wave-000", "B-wave-001"],
        ["B-walk-004", "B-walk-005"],
    ]
    assert [shot.view for shot in shots] == [View(255, azimuth) for azimuth in AZIMUTHS_DEG[:3]]
    assert len(choose_shots(Walk(), 1, 7)[0].bodies) == 7
    with pytest.raises(BadConfig, match="'open' needs a motion of 8 frames .*, found at most 7"):
        choose_shots(Walk(), 1, 8)


@pytest.mark.parametrize("second", [None, replace(RIG.projector, position_m=(-0.5, -0.3, 0.0))])
def test_a_shot_of_one_frame_is_the_sample_of_that_body(second: Camera | None) -> None:
    rig, shot = replace(RIG, second_projector=second), choose_shots(Walk(), 1, 1)[0]
    (frame,) = render_shot(Walk(), shot, rig)
    ref, body = shot.bodies[0], Walk().build(shot.bodies[0])
    parts = partition(body.mesh, body.landmarks)
    sample = Sampler(RasterRenderer(body.mesh), rig, body.mesh, parts, "open", ref).take(shot.view)
    frame.sample.check()
    assert (frame.sample.key, frame.sample.info) == (sample.key, sample.info)
    np.testing.assert_array_equal(frame.sample.range, sample.range)
    for variant in ("none", "all"):
        mine, usual = (Augmentation(rig, variant)(each) for each in (frame.sample, sample))
        np.testing.assert_array_equal(mine.range, usual.range)
        np.testing.assert_array_equal(mine.labels, usual.labels)


def test_the_camera_stands_still() -> None:
    frames = list(render_shot(Walk(0.02), choose_shots(Walk(), 1, 3)[0], SMALL))
    assert len({tuple(frame.body.camera.position) for frame in frames}) == 1
    columns = [np.nonzero(frame.sample.range)[1].mean() for frame in frames]
    steps_px = 0.02 / 2.5 * SMALL.camera.focal_px
    np.testing.assert_allclose(np.diff(columns), steps_px, rtol=0.1)


def plainly(network: Network, source: Walk, frames: int, window: int) -> dict[str, float]:
    """TC and VC of one shot without artifacts, place by place."""
    taken = list(render_shot(source, choose_shots(source, 1, frames)[0], SMALL))
    labels: list[NDArray[np.uint8]] = []
    for frame in taken:
        image = torch.from_numpy(frame.sample.range * np.float32(SMALL.range_step_m))[None, None]
        labels.append(predict(network.eval(), image).labels[0].numpy().ravel())
    both: dict[int, list[int]] = {part: [0, 0, 0] for part in range(PART_COUNT)}
    for first, later, here, there in zip(taken, taken[1:], labels, labels[1:], strict=False):
        for pixel, found in zip(first.body.pixels, follow(first.body, later.body), strict=True):
            if found != NOT_SEEN:
                both[here[pixel]][0] += 1
                both[there[found]][1] += 1
                both[here[pixel]][2] += bool(here[pixel] == there[found])
    shown = [same / (one + other - same) for one, other, same in both.values() if one + other]
    places = constant = right = 0
    for start in range(frames - window + 1):
        ways = [follow(taken[start].body, taken[start + step].body) for step in range(window)]
        for way in zip(*ways, strict=True):
            if NOT_SEEN in way:
                continue
            called = [labels[start + step][pixel] for step, pixel in enumerate(way)]
            true = [taken[start + step].sample.labels.ravel()[pixel] for step, pixel in enumerate(way)]
            places += 1
            constant += len(set(called)) == 1
            right += len(set(called)) == 1 and called == true
    return {"tc": sum(shown) / len(shown), "vc": constant / places, "vc_right": right / places}


def test_scores_are_those_of_a_plain_count() -> None:
    source = Walk()
    found = temporal({"by range": ByRange().eval()}, source, shots=1, frames=3, window=2, variants=("none",), rig=SMALL)
    wanted = plainly(ByRange(), source, 3, 2)
    scores = found["networks"]["by range"]["none"]
    assert {name: scores[name] for name in wanted} == pytest.approx(wanted, abs=1e-5)
    assert 0 < scores["vc_right"] < scores["vc"] < 1


def test_fresh_artifacts_are_what_a_still_body_flickers_by() -> None:
    done: list[tuple[int, int]] = []
    frame = next(render_shot(Walk(0.0), choose_shots(Walk(), 1, 1)[0], SMALL))
    commonest = int(np.bincount(frame.sample.labels.ravel())[:PART_COUNT].argmax())
    networks = {"by range": ByRange().eval(), "always": Always(commonest).eval()}
    found = temporal(
        networks,
        Walk(0.0),
        shots=1,
        frames=3,
        window=2,
        seed=5,
        rig=SMALL,
        progress=lambda *numbers: done.append(numbers),
    )
    assert found["truth_stays"] == 1 and 0 < found["measured_throughout"] < 1
    assert found["truth"]["tc"] == found["truth"]["vc_right"] == found["truth"]["accuracy"] == 1
    by_range, always = (found["networks"][name] for name in networks)
    assert by_range["none"]["tc"] == by_range["none"]["vc"] == 1
    assert by_range["all"]["vc"] < 0.5 and by_range["all"]["tc"] < 0.5
    assert (always["all"]["tc"], always["all"]["vc"]) == (1, 1)
    assert 0 < always["all"]["vc_right"] < 0.5
    assert by_range["all, carried"]["vc"] > by_range["all"]["vc"], "evidence of earlier frames"
    assert always["all, carried"] == always["all"], "nothing contends with a label that never changes"
    assert always["all"] == always["none"], "all variants are counted at the same places"
    assert done == [(count, 15) for count in (1, 2, 3, 6, 9, 12, 15)]


def test_the_seed_is_that_of_the_artifacts() -> None:
    pairs = [temporal({}, Walk(), shots=1, frames=2, window=2, seed=seed, rig=SMALL)["pairs"] for seed in (5, 5, 6)]
    assert pairs[0] == pairs[1] != pairs[2]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"variants": ("some",)}, "the variant must be one of"),
    ],
)
def test_options_that_cannot_be(options: dict[str, Any], message: str) -> None:
    with pytest.raises(BadConfig, match=message):
        temporal({}, Walk(), **options)


def test_figures_that_do_not_move_are_no_motion() -> None:
    with pytest.raises(BadConfig, match="needs a motion of 16 frames to test on, found at most 1"):
        temporal({}, Figures())


def seed_of(name: str, seed: int) -> Run:
    return Run(name, Path(name), Trained(ByRange(), {"seed": seed}))


def test_scores_are_over_seeds() -> None:
    groups = [
        Group("all", (seed_of("all-0", 0), seed_of("all-1", 1), seed_of("all-2", 2))),
        Group("none", (seed_of("none-0", 0), seed_of("none-1", 1))),
    ]
    networks = {
        run.name: {"all": {"tc": 0.5 + 0.1 * run.trained.card["seed"], "vc": None}}
        for each in groups
        for run in each.runs
    }
    found = motion_over_seeds(groups, networks)
    assert found["all"]["all"]["tc"] == {"mean": 0.6, "sd": 0.1, "seeds": [0.5, 0.6, 0.7]}
    assert found["none"]["all"]["vc"] is None


def test_the_bench_films_with_the_rig_of_the_set(
    small_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for seed in range(2):
        network = build("compact", {"patch": 16, "widths": (8,), "blocks": (0,)}, seed)
        save_network(tmp_path / f"all-{seed}.safetensors", network, "compact", {"variant": "all", "seed": seed})

    def one_score(networks: Any, **options: Any) -> dict[str, Any]:
        assert options["rig"] == SMALL
        return {"networks": {name: {"all": dict.fromkeys(TemporalConsistency().to_json(), 0.5)} for name in networks}}

    monkeypatch.setattr(motion, "temporal", one_score)
    found = bench_motion(str(small_set), [tmp_path / f"all-{seed}.safetensors" for seed in range(2)])
    assert found["temporal"]["groups"]["all"]["all"]["tc"] == {"mean": 0.5, "sd": 0.0, "seeds": [0.5, 0.5]}
    assert stability_tables.tables(found)["motion"][0]["TC, %"] == "50.0 ± 0.0"
