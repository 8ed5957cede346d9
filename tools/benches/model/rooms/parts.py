"""Parts of the man in the real room, whose true labels nobody knows: do they stay when the frame is mirrored?"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from benches.model.rooms.real import ROOM, RealFrame
from benches.model.variants.real import Recording, frame_of, seen_in_room
from bodyseg_model.networks import load_network
from bodyseg_model.segmentation import Background, find_bodies

NETWORKS: Final = "compact", "large"


def mirrored_parts(data: Path) -> dict[str, dict[str, dict[str, float]]]:
    """Network -> "mask", pixels that a hand marked as the man's, or "segment", those that it takes for his -> what
    `Recording.scores` gives: share of the pixels with one label, and shares with a distant one. Frames in which nothing
    is found are left out.
    """
    frames = seen_in_room(data / ROOM)
    ways = {"mask": [frame.person for frame in frames], "segment": [_his(frame) for frame in frames]}
    found: dict[str, dict[str, dict[str, float]]] = {}
    for name in NETWORKS:
        trained = load_network(name)
        found[name] = {}
        for way, people in ways.items():
            seen = [frame_of(frame, person) for frame, person in zip(frames, people, strict=True) if person.any()]
            if seen:
                found[name][way] = Recording(ROOM, seen).scores(trained)
    return found


def _his(frame: RealFrame) -> NDArray[np.bool_]:
    """Pixels of the person found who has most of the mask, bool [H, W]; all False without any."""
    found = find_bodies(frame.range_m, frame.camera, Background())
    person = np.zeros(frame.person.size, np.bool_)
    if found:
        person[max(found, key=lambda body: int(frame.person.ravel()[body.pixels].sum())).pixels] = True
    return person.reshape(frame.person.shape)
