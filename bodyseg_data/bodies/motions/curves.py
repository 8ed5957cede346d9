"""Smooth curves through key values in time, the basis of every motion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields
from operator import attrgetter
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.bodies.anny.skeleton import Arm, Leg, Pose, Trunk

Vector = NDArray[np.float64]

_NUMBERS: Final = {kind: attrgetter(*(field.name for field in fields(kind))) for kind in (Trunk, Arm, Leg)}
"""Part of a pose -> what gives its angles, in their order."""

_SPREAD: Final = np.array([1.0, 4.0, 6.0, 4.0, 1.0]) / 16


class Track:
    """Key values in time, joined smoothly and never overshooting: each value stays between its neighbouring keys.

    Monotone cubics (Fritsch and Butland 1984), averaged over `blur` seconds to both sides, so that acceleration hardly
    jumps at a key. Before the first key and after the last one the values are constant.
    """

    def __init__(self, times: Sequence[float], values: Sequence[Any], blur: float = 0.09) -> None:
        self._around = np.linspace(-blur, blur, len(_SPREAD))
        self._times = np.asarray(times, np.float64)
        self._values = np.asarray(values, np.float64).reshape(len(times), -1)
        steps = np.diff(self._times)[:, None]
        slopes = np.diff(self._values, axis=0) / steps
        before, after = slopes[:-1], slopes[1:]
        # The weighted harmonic mean, or 0 at an extreme.
        share = (1 + steps[1:] / (steps[:-1] + steps[1:])) / 3
        same = before * after > 0
        mean = np.where(same, before * after / np.where(same, share * after + (1 - share) * before, 1), 0)
        self._slopes = np.concatenate([np.zeros((1, mean.shape[1])), mean, np.zeros((1, mean.shape[1]))])

    def at(self, time: float) -> Vector:
        """Return the values [N] at a time in seconds."""
        return np.asarray(_SPREAD @ self._cubic(time + self._around))

    def one(self, time: float) -> float:
        """Return the value of a track of single values at a time in seconds."""
        return float(self.at(time)[0])

    def _cubic(self, times: Vector) -> Vector:
        times = np.clip(times, self._times[0], self._times[-1])
        left = np.clip(np.searchsorted(self._times, times, "right") - 1, 0, len(self._times) - 2)
        step = (self._times[left + 1] - self._times[left])[:, None]
        s = (times - self._times[left])[:, None] / step
        hermite: Vector = (
            (1 + 2 * s) * (1 - s) ** 2 * self._values[left]
            + s * (1 - s) ** 2 * step * self._slopes[left]
            + s * s * (3 - 2 * s) * self._values[left + 1]
            - s * s * (1 - s) * step * self._slopes[left + 1]
        )
        return hermite


class PoseTrack:
    """Key poses in time."""

    def __init__(self, keys: Sequence[tuple[float, Pose]], blur: float = 0.09) -> None:
        self._track = Track([time for time, _ in keys], [angles(pose) for _, pose in keys], blur)

    def at(self, time: float) -> Pose:
        """Return the pose at a time in seconds."""
        return from_angles(self._track.at(time))


def angles(pose: Pose) -> Vector:
    """Return all joint angles [37] of a pose: trunk, left and right arm, left and right leg."""
    parts = (pose.trunk, pose.left_arm, pose.right_arm, pose.left_leg, pose.right_leg)
    return np.array([number for part in parts for number in _NUMBERS[type(part)](part)])


def from_angles(values: Vector, decimals: int | None = None) -> Pose:
    """Return the pose of joint angles [37], rounded to `decimals` if given."""
    numbers = [float(value) if decimals is None else round(float(value), decimals) + 0.0 for value in values]
    parts: list[Any] = []
    for kind in (Trunk, Arm, Arm, Leg, Leg):
        count = len(fields(kind))
        parts.append(kind(*numbers[:count]))
        numbers = numbers[count:]
    return Pose(*parts)


def wander(time: float, number: int, seconds: float) -> float:
    """Return a slow oscillation between -1 and 1 that does not repeat; `number` selects its phases."""
    first, second = 2 * math.pi * time / seconds, 2 * math.pi * time / (seconds * 0.618)
    return 0.6 * math.sin(first + 2.4 * number) + 0.4 * math.sin(second + 1.1 * number * number)
