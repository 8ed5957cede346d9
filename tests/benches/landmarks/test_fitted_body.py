"""The open body in a known fit: its landmarks on the mesh, points carried back, lengths of limbs, and gaps."""

from __future__ import annotations

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("anny")

from benches.landmarks.body_fit import (  # noqa: E402
    LIMB_POSES,
    Fit,
    fitted_points,
)
from benches.landmarks.fitting_body import FittingBody, SurfacePoints  # noqa: E402
from benches.landmarks.proposal import POOR_M, FittedBody, gap_m  # noqa: E402
from benches.model.people.landmarks import carried  # noqa: E402
from fitting_bodies import whole_body  # noqa: E402

from bodyseg_data.bodies.anny_people import POSTURES  # noqa: E402
from bodyseg_data.labels import LANDMARKS  # noqa: E402
from bodyseg_data.meshes import Mesh  # noqa: E402

_SHAPES = 14  # principal components; lengths come after them


@pytest.fixture(scope="module")
def body() -> FittingBody:
    return whole_body()


def fitted(body: FittingBody, pose: str = "standing", scale: float = 1.1) -> FittedBody:
    zeros = [torch.zeros(count).double() for count in (len(body.deviation), len(body.head_shapes))]
    move = torch.tensor([0.3, -0.2, 0.5]).double()
    fit = Fit(body.start(dict(POSTURES)[pose]), move, torch.tensor(scale).double(), *zeros)
    vertices = fitted_points(body, fit, body.whole)[0]
    return FittedBody(Mesh("known", vertices, body.mesh.faces), body, fit, 0.0)


@pytest.mark.parametrize("pose", ["standing", "t_pose", "lunge"])
def test_landmarks_and_points_of_a_body_that_fits_exactly(body: FittingBody, pose: str) -> None:
    known = fitted(body, pose)
    proposal = known.proposal(body.landmark_vertices)
    same = np.array(proposal.landmarks.vertices) == body.landmark_vertices
    assert same.sum() >= 28  # where skin folds, as in an armpit, normals of blended bones are not those of the mesh
    assert proposal.distance_m[same].max() < 1e-9 and proposal.distance_m.max() < 0.03 and not proposal.poor
    there = carried(known, known.mesh.vertices[body.landmark_vertices])
    away = np.linalg.norm(there - body.mesh.vertices[body.landmark_vertices], axis=1)
    assert (away < 1e-9).sum() >= 28 and away.max() < 0.03


def test_lengths_move_what_hangs_from_a_segment_and_nothing_else(body: FittingBody) -> None:
    def at(name: str, heads: torch.Tensor) -> np.ndarray:
        return heads[body.bones[name]].numpy()  # type: ignore[no-any-return]

    forearm = body.head_shapes[_SHAPES + 4]  # from the elbow to the wrist
    moved = body.heads + forearm
    for side in ("L", "R"):
        before, after = (
            np.linalg.norm(at(f"wrist.{side}", heads) - at(f"lowerarm01.{side}", heads))
            for heads in (body.heads, moved)
        )
        assert after / before == pytest.approx(1.06)
        assert not at(f"upperarm01.{side}", forearm).any() and not at(f"foot.{side}", forearm).any()
        np.testing.assert_allclose(at(f"finger3-3.{side}", forearm), at(f"wrist.{side}", forearm))
    shift = body.whole.shapes[_SHAPES + 4].numpy()
    hand = body.landmark_vertices[LANDMARKS.index("Lt. Dactylion")]
    np.testing.assert_allclose(shift[hand], at("wrist.L", forearm), atol=1e-4)
    still = body.landmark_vertices[[LANDMARKS.index(name) for name in ("Sellion", "Substernale", "Lt. Digit II")]]
    assert not shift[still].any()
    assert len(body.head_shapes) == _SHAPES + 9 == len(body.whole.shapes)


def test_a_gap_is_that_of_the_farthest_hundredth() -> None:
    line = np.stack([np.arange(1001.0), np.zeros(1001), np.zeros(1001)], axis=1)

    def points(positions: np.ndarray) -> SurfacePoints:
        return SurfacePoints(positions, np.zeros_like(positions), np.ones(len(positions)))

    own = line.copy()
    assert gap_m(points(line), points(own)) == 0
    own[:9, 1] = 7  # nine of 1001 points: less than a hundredth
    assert gap_m(points(line), points(own)) == 0
    own[:15, 1] = 7
    assert gap_m(points(line), points(own)) == pytest.approx(7)


def test_a_poor_fit_says_so(body: FittingBody) -> None:
    known = fitted(body)
    for gap, poor in ((POOR_M - 0.001, False), (POOR_M + 0.001, True)):
        found = FittedBody(known.mesh, body, known.fit, gap).proposal(body.landmark_vertices)
        assert found.poor is poor and found.gap_m == gap


def test_limbs_to_try_reach_all_round(body: FittingBody) -> None:
    hands, feet = (
        np.stack(
            [
                body.bone_motions(body.start(pose)[None], torch.zeros(1, len(body.head_shapes)).double())[
                    0, body.bones[bone]
                ].numpy()
                @ [*body.heads[body.bones[bone]].numpy(), 1.0]
                for pose in LIMB_POSES[kind]
            ]
        )
        for kind, bone in (("arm", "wrist.L"), ("leg", "foot.L"))
    )
    shoulder, hip = (body.heads[body.bones[name]].numpy() for name in ("upperarm01.L", "upperleg01.L"))
    assert (hands[:, 1] > shoulder[1] + 0.3).any() and (hands[:, 1] < shoulder[1] - 0.4).any()
    assert (hands[:, 2] > shoulder[2] + 0.4).any() and (hands[:, 2] < shoulder[2] - 0.15).any()
    assert (hands[:, 0] < 0.06).any() and (hands[:, 0] > shoulder[0] + 0.4).any()
    assert (feet[:, 1] > hip[1] - 0.3).any() and (feet[:, 2] < hip[2] - 0.25).any()
    assert (feet[:, 2] > hip[2] + 0.4).any()
