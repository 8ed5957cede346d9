"""Laying the open body over a surface: closing in from a start, and how well it lies.

Matching points are alike in place, in direction and in how far out on the body they lie, all at once: nearest in
(place, reach x normal, reach x remoteness). That keeps a chest from taking hold of a back, and a hand of a hip.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray

from bodyseg_data.bodies.landmark_fitting.surface import FEATURE, Points
from bodyseg_data.bodies.landmark_fitting.template import FittingBody, Skin, Tensor
from bodyseg_data.core.system_libraries import missing_library

Stage = tuple[int, float, float]
"""Steps, distance in metres beyond which a match loses its pull, and rate of one stage of closing in."""

_NORMAL_REACH_M: Final = 0.15
ROUGH_REACH_M: Final = 0.3
"""For remoteness, while limbs may still be anywhere."""

FINE_REACH_M: Final = 0.1
"""For remoteness, once every limb lies in its place: loose clothes make ways across the body longer."""

_LIMIT_M: Final = 0.25  # a point without a counterpart counts as this far
_MATCH_EVERY: Final = 5  # steps
_ALONG: Final = 0.15  # weight of distance along the surface beside that across it
_BEND_PRIOR: Final = 2e-6  # square metres that one usual bend of a joint costs
_SHAPE_PRIOR: Final = 4e-6
_USUAL_SCALE: Final = 0.3  # of the size, beyond what shapes explain
_ROOT: Final = 3  # movements of the root, which may turn freely


@dataclass(frozen=True)
class Fit:
    """The open body laid over a surface.

    start: rotations [bones, 3, 3] of the pose it began from. move: [3], metres, after scale. bends: [movements], on top
    of start; shape: [shapes].
    """

    start: Tensor
    move: Tensor
    scale: Tensor
    bends: Tensor
    shape: Tensor

    def turns(self, body: FittingBody) -> Tensor:
        """Rotations [bones, 3, 3] of the pose that it ended in."""
        return _bent(body, self.start, self.bends)


def lay(body: FittingBody, fit: Fit, skin: Skin) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points and normals [N, 3] of `skin` where a fit puts them."""
    with torch.inference_mode():
        shape = fit.shape[None]
        places, normals = body.posed(skin, body.bone_motions(fit.turns(body)[None], shape), shape)
        return (places[0] * fit.scale + fit.move).numpy(), normals[0].numpy()


def laid(body: FittingBody, fit: Fit, count: int | None = None) -> Points:
    """The body's surface where a fit puts it, or `count` points of it."""
    count = len(body.remoteness) if count is None else count
    return Points(*lay(body, fit, body.surface.first(count)), body.remoteness[:count])


def apart(target: Points, own: Points) -> float:
    """How far two surfaces are from each other: mean distance of matches, both ways, metres and the like."""
    return Matcher(target).distance(own) + Matcher(own).distance(target)


class Matcher:
    """Finds the match of points among those of one surface. Raises MissingLibrary without scipy."""

    def __init__(self, points: Points, reach_m: float = ROUGH_REACH_M) -> None:
        try:
            from scipy.spatial import KDTree
        except ImportError as error:
            raise missing_library(FEATURE, error) from error
        self._reach_m = reach_m
        self._tree: Any = KDTree(self._features(points))

    def match(self, points: Points) -> Tensor:
        """Index of each one's match, [N]."""
        return torch.from_numpy(self._tree.query(self._features(points))[1])

    def distance(self, points: Points) -> float:
        """Mean distance to the matches, each counted up to a limit."""
        return float(np.minimum(self._tree.query(self._features(points))[0], _LIMIT_M).mean())

    def _features(self, points: Points) -> NDArray[np.float64]:
        remoteness = self._reach_m * points.remoteness[:, None]
        return np.concatenate([points.places, _NORMAL_REACH_M * points.normals, remoteness], axis=1)


def refine(
    body: FittingBody,
    target: Points,
    fits: Sequence[Fit],
    stages: Sequence[Stage],
    count: int,
    reach_m: float = ROUGH_REACH_M,
) -> list[Fit]:
    """Turn, move, bend and shape the body, in each of `fits` by itself, until its surface meets the target's.

    Adam (Kingma and Ba 2015) on the distances of matches, mostly across the surface, of which far ones lose their pull
    (Geman and McClure 1985); unusual bends and shapes cost something. count: of the body's points, to match.
    """
    if not fits:
        return []
    matcher = Matcher(target, reach_m)
    places, facing = torch.from_numpy(target.places), torch.from_numpy(target.normals)
    skin, remoteness = body.surface.first(count), body.remoteness[:count]
    start = torch.stack([fit.start for fit in fits])
    usual_scale = torch.log(torch.stack([fit.scale for fit in fits]))[:, None, None]
    bends = (torch.stack([fit.bends for fit in fits]) / body.joints.spread).requires_grad_()
    shape = torch.stack([fit.shape for fit in fits]).requires_grad_()
    move = torch.stack([fit.move for fit in fits])[:, None].requires_grad_()
    log_scale = usual_scale.clone().requires_grad_()
    adam = torch.optim.Adam([{"params": [bends]}, {"params": [shape]}, {"params": [move, log_scale]}])
    for steps, reach, rate in stages:
        for group, factor in zip(adam.param_groups, (5.0, 10.0, 0.5), strict=True):
            group["lr"] = rate * factor
        for step in range(steps):
            turns = _bent(body, start, bends * body.joints.spread)
            own, normals = body.posed(skin, body.bone_motions(turns, shape), shape)
            own = own * log_scale.exp() + move
            if step % _MATCH_EVERY == 0:
                now = [
                    Points(*both, remoteness)
                    for both in zip(own.detach().numpy(), normals.detach().numpy(), strict=True)
                ]
                there = torch.stack([matcher.match(points) for points in now])
                back = torch.stack([Matcher(points, reach_m).match(target) for points in now])
            returned = own.gather(1, back[..., None].expand(-1, -1, 3))
            squares = torch.cat([_squares(own - places[there], facing[there]), _squares(returned - places, facing)], 1)
            # Each fit by itself: Adam's steps do not depend on how many there are.
            loss = (reach**2 * squares / (reach**2 + squares)).mean(dim=1).sum()
            loss = loss + _BEND_PRIOR * (bends[:, _ROOT:] ** 2).sum()
            loss = loss + _SHAPE_PRIOR * ((shape**2).sum() + (((log_scale - usual_scale) / _USUAL_SCALE) ** 2).sum())
            adam.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            adam.step()
    found = (move[:, 0], log_scale[:, 0, 0].exp(), bends * body.joints.spread, shape)
    return [Fit(*each) for each in zip(start, *(value.detach() for value in found), strict=True)]


def _squares(away: Tensor, normals: Tensor) -> Tensor:
    across = (away * normals).sum(dim=-1) ** 2
    return (1 - _ALONG) * across + _ALONG * (away**2).sum(dim=-1)


def _bent(body: FittingBody, start: Tensor, bends: Tensor) -> Tensor:
    return start @ _rotations(torch.einsum("...m,mbd->...bd", bends, body.joints.turns))


def _rotations(vectors: Tensor) -> Tensor:
    """Rodrigues' formula, [..., 3] -> [..., 3, 3], with gradients at zero."""
    angle = torch.sqrt((vectors**2).sum(dim=-1) + 1e-16)[..., None, None]
    x, y, z = vectors.unbind(dim=-1)
    o = torch.zeros_like(x)
    cross = torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=-1).reshape(*vectors.shape, 3)
    eye = torch.eye(3, dtype=torch.float64)
    rotation: Tensor = eye + torch.sin(angle) / angle * cross + (1 - torch.cos(angle)) / angle**2 * (cross @ cross)
    return rotation
