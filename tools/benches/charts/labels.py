"""Placement of labels beside their points, so that none covers another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_DIRECTIONS: Final = np.deg2rad(np.arange(0, 360, 15))
_REACHES: Final = np.array([3.0, 8.0, 15.0, 25.0, 40.0, 60.0, 85.0, 120.0])
"""Distances of a label from its marker that are tried, pixels."""

# Costs of a position, in pixels of distance from the marker that would be as bad.
_OUTSIDE: Final = 1e6
_ON_A_NAME: Final = 1e4
_LEADER_ON_A_NAME: Final = 200.0
_ON_A_DOT: Final = 3.0  # for each square pixel of its radius
_BESIDE_ANOTHER: Final = 15.0  # the label would seem to be that point's
_ON_A_LINE: Final = 18.0
_LATER: Final = 10.0  # for each anchor before the one used
_BESIDE: Final = 8.0  # pixels
_GAP: Final = 2.0  # between two names


@dataclass(frozen=True)
class Label:
    """A label. size: [2] width and height; anchors: [A, 2] points that it may belong to, the best first; radius: of the
    marker there. All in pixels.
    """

    size: Floats
    anchors: Floats
    radius: float


@dataclass(frozen=True)
class Placed:
    """A placed label: its lower left corner [2], the anchor [2] it belongs to, and its point [2] nearest to that."""

    corner: Floats
    anchor: Floats
    nearest: Floats


def place_labels(labels: Sequence[Label], dots: Floats, lines: Floats, area: Floats) -> list[Placed]:
    """Place labels one after the other where each covers the least, in the best of several orders.

    dots: [M, 3] positions and radii of all markers; lines: [K, 2] points along lines; area: [4] left, bottom, right,
    top, which no label leaves if there is room. All in pixels.
    """
    options = [_options(label, dots, lines, area) for label in labels]
    around = sorted(range(len(labels)), key=lambda number: tuple(labels[number].anchors[0]))
    turns = [around[turn:] + around[:turn] for turn in range(len(labels))]
    found = [_placed(order, options) for order in (*turns, *(turn[::-1] for turn in turns))]
    best = min(found, key=lambda one: one[0], default=(0.0, {}))[1]
    return [best[number] for number in range(len(labels))]


@dataclass(frozen=True)
class _Options:
    """Candidate positions of a label: boxes [C, 4], their anchors [C, 2], leaders from these [C, 9, 2], costs [C]."""

    boxes: Floats
    anchors: Floats
    leaders: Floats
    cost: Floats


def _options(label: Label, dots: Floats, lines: Floats, area: Floats) -> _Options:
    """Candidates all round each anchor at several distances, other labels ignored."""
    around = np.stack([np.cos(_DIRECTIONS), np.sin(_DIRECTIONS)], axis=1)
    offsets = around * (label.radius + _REACHES[:, None, None] + label.size / 2)  # [reach, direction, 2]
    each = offsets.shape[0] * offsets.shape[1]
    corners = (label.anchors[:, None, None] + offsets - label.size / 2).reshape(-1, 2)
    boxes, anchors = np.concatenate([corners, corners + label.size], axis=1), np.repeat(label.anchors, each, axis=0)
    outside = (boxes[:, :2] < area[:2]).any(axis=1) | (boxes[:, 2:] > area[2:]).any(axis=1)
    cost = np.tile(np.repeat(_REACHES, len(around)), len(label.anchors)) + _OUTSIDE * outside
    cost += np.repeat(_LATER * np.arange(len(label.anchors)), each)
    cost += _ON_A_LINE * _covered(boxes, lines, 1.0).sum(axis=1)
    cost += _covered(boxes, dots[:, :2], dots[:, 2]) @ (_ON_A_DOT * dots[:, 2] ** 2)
    others = dots[np.abs(dots[:, None, :2] - label.anchors).max(axis=2).min(axis=1) > 1]
    cost += _BESIDE_ANOTHER * _covered(boxes, others[:, :2], others[:, 2] + _BESIDE).sum(axis=1)
    nearest = np.clip(anchors, boxes[:, :2], boxes[:, 2:])
    leaders = anchors[:, None] + np.linspace(0, 1, 9)[:, None] * (nearest - anchors)[:, None]
    return _Options(boxes, anchors, leaders, cost)


def _placed(order: Sequence[int], options: Sequence[_Options]) -> tuple[float, dict[int, Placed]]:
    """Cost of placing labels in this order, and their positions by index."""
    total, placed = 0.0, {}
    taken: list[tuple[Floats, Floats]] = []
    for number in order:
        one = options[number]
        cost = one.cost.copy()
        for box, leader in taken:
            cost += _ON_A_NAME * _overlap(one.boxes, box)
            through = _covered(box[None], one.leaders.reshape(-1, 2), 0.0).reshape(len(cost), -1)
            cost += _LEADER_ON_A_NAME * (through.any(axis=1) | _covered(one.boxes, leader, 1.0).any(axis=1))
        best = int(cost.argmin())
        total += float(cost[best])
        taken.append((one.boxes[best], one.leaders[best]))
        placed[number] = Placed(one.boxes[best, :2], one.anchors[best], one.leaders[best, -1])
    return total, placed


def _covered(boxes: Floats, points: Floats, radii: Floats | float) -> NDArray[np.bool_]:
    """True where a box [C, 4] touches a marker [M, 2] of these radii: bool [C, M]."""
    margin = np.broadcast_to(radii, len(points))[:, None]
    low, high = boxes[:, None, :2] - margin, boxes[:, None, 2:] + margin
    inside: NDArray[np.bool_] = ((points > low) & (points < high)).all(axis=2)
    return inside


def _overlap(boxes: Floats, other: Floats) -> NDArray[np.bool_]:
    apart: NDArray[np.bool_] = (boxes[:, 2:] + _GAP < other[:2]) | (other[2:] + _GAP < boxes[:, :2])
    return np.logical_not(apart.any(axis=1))
