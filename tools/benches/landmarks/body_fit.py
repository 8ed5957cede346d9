"""Fitting the open body to a surface: gradient steps from a start, and the distance that remains.

A point's match is the nearest one in (position, reach x normal, reach x mean geodesic distance). So a chest is not
matched with a back, nor a hand with a hip.

Arms and legs to try are a grid over the ranges of shoulder, elbow, hip, knee and ankle.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from benches.landmarks.fitting_body import FittingBody, Skin, SurfacePoints, Tensor
from bodyseg_data.bodies.skeleton import Arm, Leg, Pose, Trunk

_ELBOWS_DEG: Final = (12, 75, 130)

ARMS: Final = (
    *(
        Arm(flex=flex, abduct=8, twist=twist, elbow=elbow)
        for flex in (0, 50, 100, 160)
        for twist in (-50, 0)
        for elbow in _ELBOWS_DEG
    ),
    *(
        Arm(abduct=abduct, twist=twist, elbow=elbow)
        for abduct in (50, 100, 150)
        for twist in (0, 80)
        for elbow in _ELBOWS_DEG
    ),
    Arm(flex=-40, abduct=16, elbow=12),
    Arm(flex=-35, abduct=40, twist=-45, elbow=85),
)
"""Raised to the front, to the side, and to the back, turned and bent."""

LEGS: Final = tuple(
    Leg(flex=flex, abduct=abduct, twist=twist, knee=knee, planted=0, ankle=ankle)
    for flex in (-5, 45, 95)
    for abduct, twist in ((0, 5), (35, 55))
    for knee, ankle in ((5, 0), (55, 20), (100, 5), (100, 45), (135, 25))
)
"""Raised to the front and to the side, bent at the knee; the foot square to the shin, or pointed."""

LIMB_POSES: Final = {
    "arm": tuple(Pose(Trunk(), arm, arm, Leg(), Leg()) for arm in ARMS),
    "leg": tuple(Pose(Trunk(), Arm(), Arm(), leg, leg) for leg in LEGS),
}
"""Poses that hold each of them on both sides."""


Stage = tuple[int, float, float]
"""(steps, distance in metres beyond which a match loses weight, learning rate) of one stage of a fit."""

_NORMAL_REACH_M: Final = 0.15
ROUGH_REACH_M: Final = 0.3
"""Reach of the mean geodesic distance in a match, metres, while limbs may still be anywhere."""

FINE_REACH_M: Final = 0.1
"""The same once every limb is matched: loose clothes lengthen distances along the surface."""

_LIMIT_M: Final = 0.25  # a point without a counterpart counts as this far
_MATCH_EVERY: Final = 5  # steps between searches for matches
_ALONG: Final = 0.4  # weight of distance along the surface beside that across it
_REMOTE: Final = 3  # power of the mean geodesic distance that weighs a point: hands and feet are small
_ANGLE_PRIOR: Final = 1e-6  # square metres added to the loss for one standard deviation of a movement
_SHAPE_PRIOR: Final = 1e-6
_USUAL_SCALE: Final = 0.3  # of the size, beyond what shapes explain
_ROOT: Final = 3  # movements of the root, which may turn freely


@dataclass(frozen=True)
class Fit:
    """Parameters of the open body fitted to a surface.

    start: rotations [bones, 3, 3] of the pose it began from. move: [3], metres, after scale. angles: [movements], on
    top of start, radians; shape: [shapes].
    """

    start: Tensor
    move: Tensor
    scale: Tensor
    angles: Tensor
    shape: Tensor

    def turns(self, body: FittingBody) -> Tensor:
        """Return the rotations [bones, 3, 3] of the fitted pose."""
        return _rotated(body, self.start, self.angles)


def fitted_points(body: FittingBody, fit: Fit, skin: Skin) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return points and normals [N, 3] of `skin` in a fit."""
    with torch.inference_mode():
        shape = fit.shape[None]
        positions, normals = body.posed(skin, body.bone_motions(fit.turns(body)[None], shape), shape)
        return (positions[0] * fit.scale + fit.move).numpy(), normals[0].numpy()


def fitted_surface(body: FittingBody, fit: Fit, count: int | None = None) -> SurfacePoints:
    """Return the body's surface in a fit, or `count` points of it."""
    count = len(body.mean_geodesic) if count is None else count
    return SurfacePoints(*fitted_points(body, fit, body.surface.first(count)), body.mean_geodesic[:count])


def surface_distance(target: SurfacePoints, own: SurfacePoints) -> float:
    """Distance of two surfaces: mean distance of matches from either to the other, in metres of position and reach."""
    return Matcher(target).distance(own) + Matcher(own).distance(target)


class Matcher:
    """Finds the matches of points among those of one surface."""

    def __init__(self, points: SurfacePoints, reach_m: float = ROUGH_REACH_M) -> None:
        from scipy.spatial import KDTree

        self._reach_m = reach_m
        self._tree: Any = KDTree(self._features(points))

    def match(self, points: SurfacePoints) -> Tensor:
        """Return the index of each point's match, int64 [N]."""
        return torch.from_numpy(self._tree.query(self._features(points))[1])

    def distance(self, points: SurfacePoints) -> float:
        """Return the mean distance to the matches, each clipped at a limit."""
        return float(np.minimum(self._tree.query(self._features(points))[0], _LIMIT_M).mean())

    def _features(self, points: SurfacePoints) -> NDArray[np.float64]:
        mean_geodesic = self._reach_m * points.mean_geodesic[:, None]
        return np.concatenate([points.positions, _NORMAL_REACH_M * points.normals, mean_geodesic], axis=1)


def refine(
    body: FittingBody,
    target: SurfacePoints,
    fits: Sequence[Fit],
    stages: Sequence[Stage],
    count: int,
    reach_m: float = ROUGH_REACH_M,
) -> list[Fit]:
    """Fit rotation, position, joint angles and shape of the body to the target, from each of `fits` separately.

    Adam (Kingma and Ba 2015) on the distances of matches, mostly across the surface, with the robust loss of Geman and
    McClure (1985) and priors on angles and shapes. count: number of the body's points to match.
    """
    if not fits:
        return []
    matcher = Matcher(target, reach_m)
    positions, facing = torch.from_numpy(target.positions), torch.from_numpy(target.normals)
    skin, mean_geodesic = body.surface.first(count), body.mean_geodesic[:count]
    importance = torch.from_numpy(np.concatenate([mean_geodesic, target.mean_geodesic])) ** _REMOTE
    importance = importance / importance.mean()
    start = torch.stack([fit.start for fit in fits])
    usual_scale = torch.log(torch.stack([fit.scale for fit in fits]))[:, None, None]
    angles = (torch.stack([fit.angles for fit in fits]) / body.deviation).requires_grad_()
    shape = torch.stack([fit.shape for fit in fits]).requires_grad_()
    move = torch.stack([fit.move for fit in fits])[:, None].requires_grad_()
    log_scale = usual_scale.clone().requires_grad_()
    adam = torch.optim.Adam([{"params": [angles]}, {"params": [shape]}, {"params": [move, log_scale]}])
    for steps, reach, rate in stages:
        for group, factor in zip(adam.param_groups, (5.0, 10.0, 0.5), strict=True):
            group["lr"] = rate * factor
        for step in range(steps):
            turns = _rotated(body, start, angles * body.deviation)
            own, normals = body.posed(skin, body.bone_motions(turns, shape), shape)
            own = own * log_scale.exp() + move
            if step % _MATCH_EVERY == 0:
                now = [
                    SurfacePoints(*both, mean_geodesic)
                    for both in zip(own.detach().numpy(), normals.detach().numpy(), strict=True)
                ]
                there = torch.stack([matcher.match(points) for points in now])
                back = torch.stack([Matcher(points, reach_m).match(target) for points in now])
            returned = own.gather(1, back[..., None].expand(-1, -1, 3))
            squares = torch.cat(
                [_squares(own - positions[there], facing[there]), _squares(returned - positions, facing)], 1
            )
            # Summed over fits: Adam's steps for one do not depend on the others.
            robust = reach**2 * squares / (reach**2 + squares)
            loss = (robust * importance).mean(dim=1).sum()
            loss = loss + _ANGLE_PRIOR * (angles[:, _ROOT:] ** 2).sum()
            loss = loss + _SHAPE_PRIOR * ((shape**2).sum() + (((log_scale - usual_scale) / _USUAL_SCALE) ** 2).sum())
            adam.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            adam.step()
    found = (move[:, 0], log_scale[:, 0, 0].exp(), angles * body.deviation, shape)
    return [Fit(*each) for each in zip(start, *(value.detach() for value in found), strict=True)]


def _squares(away: Tensor, normals: Tensor) -> Tensor:
    across = (away * normals).sum(dim=-1) ** 2
    return (1 - _ALONG) * across + _ALONG * (away**2).sum(dim=-1)


def _rotated(body: FittingBody, start: Tensor, angles: Tensor) -> Tensor:
    return start @ _rotations(torch.einsum("...m,mbd->...bd", angles, body.turns))


def _rotations(vectors: Tensor) -> Tensor:
    """Rodrigues' formula, [..., 3] -> [..., 3, 3], with gradients at zero."""
    angle = torch.sqrt((vectors**2).sum(dim=-1) + 1e-16)[..., None, None]
    x, y, z = vectors.unbind(dim=-1)
    o = torch.zeros_like(x)
    cross = torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=-1).reshape(*vectors.shape, 3)
    eye = torch.eye(3, dtype=torch.float64)
    rotation: Tensor = eye + torch.sin(angle) / angle * cross + (1 - torch.cos(angle)) / angle**2 * (cross @ cross)
    return rotation
