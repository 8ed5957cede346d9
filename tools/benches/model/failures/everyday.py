"""`bench everyday`: how the poses of the source `everyday` are found, and which postures of `hard` they come near."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benches.data.surface.interpenetration import Skin
from benches.model.failures.poses import directions
from bodyseg_data.bodies import BodyRef
from bodyseg_data.bodies.contact_poses import DEEPEST_M
from bodyseg_data.bodies.skeleton import Pose
from bodyseg_data.bodies.sources.hard import HardBodies
from bodyseg_data.bodies.sources.open_bodies import EverydayBodies, OpenBodies, WideBodies
from bodyseg_data.core import ProgressCallback, silent

_NEAR_DEG: Final = 15
_SEGMENTS: Final = 11  # of `directions`, those that point along segments
_NEUTRAL: Final = "a_pose"
_TURNED: Final = "turned"

Floats = NDArray[np.float64]


def bench_everyday(views: int = 130, progress: ProgressCallback = silent) -> dict[str, Any]:
    """Draw `views` bodies, evenly spread over the source in rounds of its stances.

    "seconds": of processor for a pose, mean and 95th percentile. "attempts": poses drawn for one accepted.
    "unresolved": share of bodies whose skin goes deeper than is accepted, since
    no attempt was better. "contact_mm", "over_10_mm", "over_20_mm": of the bare bodies, as `bench interpenetration`.
    "coverage": share of the postures of `hard` that are within 15 degrees of a training pose, mean of the angles
    between segments of the body, for `open` and `wide` alone, and with these bodies.
    """
    source, opened = EverydayBodies(), OpenBodies()
    skin = Skin(opened.build(next(ref for ref in opened.bodies() if ref.pose == _NEUTRAL)))
    stances = len({ref.pose for ref in source.bodies()})
    chosen = _spread(source.bodies(), stances, -(-views // stances))[:views]
    source.drawn(chosen[0])  # loads the model
    seconds, contacts, drawn = [], [], []
    for done, ref in enumerate(chosen, 1):
        begun = time.process_time()
        drawn.append(source.drawn(ref))
        seconds.append(time.process_time() - begun)
        mesh = source.build(ref, dressed=False).mesh
        contacts.append(skin.measured(mesh, mesh).contact)
        progress(done, len(chosen))
    depths, attempts = np.array(contacts), np.array([each.attempts for each in drawn])
    return {
        "bodies": len(chosen),
        "seconds": {"mean": round(float(np.mean(seconds)), 2), "p95": round(float(np.quantile(seconds, 0.95)), 2)},
        "attempts": round(float(attempts.mean()), 2),
        "unresolved": round(float(np.mean([each.deepest_m > DEEPEST_M for each in drawn])), 3),
        "contact_mm": round(float(depths.max()) * 1e3),
        "over_10_mm": round(float((depths > 0.01).mean()), 3),
        "over_20_mm": round(float((depths > 0.02).mean()), 3),
        "coverage": _coverage([each.pose for each in drawn]),
    }


def _spread(bodies: Sequence[BodyRef], stances: int, rounds: int) -> list[BodyRef]:
    whole = len(bodies) // stances
    starts = sorted({round(index * whole / rounds) % whole * stances for index in range(min(rounds, whole))})
    return [body for start in starts for body in bodies[start : start + stances]]


def _coverage(poses: Sequence[Pose]) -> dict[str, float]:
    wide, hard = WideBodies(), HardBodies()
    known = _known(wide.figure(ref).pose for ref in wide.bodies() if ref.split == "train")
    targets = [directions(hard.figure(ref).pose) for ref in hard.bodies() if not ref.pose.startswith(_TURNED)]
    both = np.concatenate([known, _known(poses)])
    return {"before": _share_near(known, targets), "after": _share_near(both, targets)}


def _known(poses: Iterable[Pose]) -> Floats:
    """Directions of poses and of their mirror images, [2 N, segments, 3]."""
    listed = list(poses)
    return np.array([directions(each)[:_SEGMENTS] for pose in listed for each in (pose, pose.mirrored())])


def _share_near(known: Floats, targets: Sequence[Floats]) -> float:
    nearest = [
        np.degrees(np.arccos(np.clip((known * target[:_SEGMENTS]).sum(axis=2), -1, 1))).mean(axis=1).min()
        for target in targets
    ]
    return round(float((np.array(nearest) <= _NEAR_DEG).mean()), 3)
