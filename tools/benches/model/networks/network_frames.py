"""Frames on which `bench network` times networks."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from benches.measuring import mixed
from bodyseg_data.artifacts import Augmentation
from bodyseg_data.packing import Packing
from bodyseg_data.packing.packer import render_run
from bodyseg_data.samples import ViewGrid, metres
from bodyseg_data.shards import decode_sample

SENSOR_SIZE = (1920, 988)
"""Rows and columns of the paper's sensor, before it was down-sampled by three (section 3.1)."""


def typical_frames(count: int) -> list[NDArray[np.float32]]:
    """`count` views of as many open bodies, spread over postures and views, as X_all shows them: [H, W], metres.

    Raises MissingLibrary without Anny.
    """
    packing = Packing("open", meshes=count)
    views, show = list(ViewGrid(span_deg=360)), Augmentation(packing.rig, "all")
    frames = []
    for number, body in enumerate(packing.bodies()):
        rendered = render_run(packing, body, (mixed(views, number),))
        (sample,) = (decode_sample(key, members) for key, members in rendered.samples)
        frames.append(metres(show(sample).range, packing.rig.range_step_m))
    return frames


def body_rectangle(frame: NDArray[np.float32]) -> NDArray[np.float32]:
    """The smallest rectangle of `frame` [H, W] that holds all that was measured."""
    rows, columns = (np.flatnonzero((frame > 0).any(axis=axis)) for axis in (1, 0))
    return np.ascontiguousarray(frame[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1])


def stretched(frame: NDArray[np.float32], rows: int, columns: int) -> NDArray[np.float32]:
    """The body of `frame` [H, W] drawn out to fill [rows, columns], by nearest neighbours: there is nothing to crop."""
    body = body_rectangle(frame)
    indices = (
        ((np.arange(size) + 0.5) / size * old).astype(np.intp)
        for size, old in zip((rows, columns), body.shape, strict=True)
    )
    return body[np.ix_(*indices)]


def as_batch(frame: NDArray[np.float32], together: int, device: torch.device) -> torch.Tensor:
    """`together` copies of a frame [H, W] as a network takes them, float32 [B, 1, H, W], on the device."""
    return torch.from_numpy(frame).to(device).repeat(together, 1, 1, 1)
