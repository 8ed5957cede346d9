"""The paper's rig with a quarter of the pixels a side, for tests that take many pictures."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from bodyseg_data.core.rig import Camera, Rig, load_rig


def _small(device: Camera) -> Camera:
    return replace(device, rows=160, columns=82, focal_px=device.focal_px / 4, centre_px=(41.0, 80.0))


def _small_rig() -> Rig:
    rig = load_rig()
    return replace(rig, name="small", camera=_small(rig.camera), projector=_small(rig.projector))


SMALL: Final = _small_rig()
