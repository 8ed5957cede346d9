"""From finished renders to shards, in the source's order.

Of the first renders, what camera and projector see is compared: whether both can be of one scene by the rig.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, BadSample, ProgressCallback, check_int, silent
from bodyseg_data.files import parse_json, write_atomically
from bodyseg_data.machine import MOST_THREADS, processors
from bodyseg_data.packing.shard_writer import ShardWriter
from bodyseg_data.packing.writing import writing_into
from bodyseg_data.renders import Render, RenderSource
from bodyseg_data.rigs import Camera, Rig
from bodyseg_data.shards import CodecName, Manifest, ProjectorKind, read_manifest

_NOTE: Final = ".renders.json"  # beside the shards: key -> fingerprint of the render that its sample was made from

_CHECKED: Final = 4  # number of renders whose two views are compared: a mistake in a set is in all of it
_POINTS: Final = 4000
_FEWEST: Final = 100
_SLACK: Final = 0.02  # metres, and share of the range, that two renderers may differ by
_REFUSED: Final = 0.2
_FITTING: Final = 0.1

Ranges = NDArray[np.floating[Any]]


def pack_renders(
    source: RenderSource,
    out: Path,
    codec: CodecName,
    projector: ProjectorKind | None,
    shard_samples: int,
    workers: int | None,
    progress: ProgressCallback = silent,
) -> Manifest:
    """Pack renders into the folder `out` and return its manifest; carries on where an interrupted packing stopped.

    projector, codec, shard_samples: as of `ShardWriter`. workers: threads that read and encode (default: one a
    processor). Renders of finished shards are not read again: BadConfig where they, or what set.toml says, were others.
    Raises BadSample for the first render that breaks a rule, and as `ShardWriter`.
    """
    if projector == "none":
        source = source.without_projector()
    keys = source.keys()
    checked = frozenset(keys[:_CHECKED])

    def arguments(key: str) -> dict[str, Any]:
        render = source.load(key)
        if key in checked:
            check_plausible(render, source.rigs[render.rig], key)
        given = dict(vars(render))
        del given["key"]
        return given

    with ShardWriter(
        out,
        rig=source.rigs,
        classes=source.classes,
        projector=projector,
        planes=source.planes,
        fields=source.fields,
        codec=codec,
        shard_samples=shard_samples,
        workers=processors() if workers is None else check_int("workers", workers, 0, MOST_THREADS),
        progress=lambda done, _: progress(done, len(keys)),
    ) as writer:
        with writing_into(out):
            check_unchanged(source, writer.finished(), out)
        progress(sum(key in writer for key in keys), len(keys))
        writer.write_all({key: key for key in keys if key not in writer}, arguments)
    return read_manifest(out)


def check_unchanged(source: RenderSource, packed: Mapping[str, Path], out: Path) -> None:
    """Raise BadConfig if a finished shard holds a sample of other renders, or as another set.toml reads them; else note
    in `out` what its samples are made of. A sample without a note must be no older than its files.
    """
    keys = source.keys()
    note, made = out / _NOTE, {key: source.fingerprint(key) for key in keys}
    known = parse_json(note.read_bytes(), str(note)) if note.exists() else {}
    for key, tar in packed.items():
        if key not in made:
            raise BadConfig(f"{tar} holds the sample {key!r}, which is gone from the renders: pack into another folder")
        newer = key not in known and any(file.stat().st_mtime > tar.stat().st_mtime for file in source.files(key))
        if newer or known.get(key, made[key]) != made[key]:
            other = f"{tar} holds the sample {key!r} from other files, or by another set.toml or table of samples"
            raise BadConfig(f"{other}: pack into another folder, or delete {out} and pack again")
    write_atomically(note, json.dumps(made).encode())


def check_plausible(render: Render, rig: Rig, where: str) -> None:
    """Raise BadSample if what the camera sees contradicts what the first projector sees.

    A point that one of the two sees lies where the other sees a surface, or behind it; one before it, or where the
    other sees nothing, contradicts. Up to `_REFUSED` of the points may, as thin things and small offsets make them.
    Mirrored images are told by their fitting once they are turned; nothing can be told of scenes that look the same in
    a mirror, nor of images that are all upside down before a rig whose devices lie side by side.
    """
    if render.projector_range_m is None:
        return
    seen, lit = render.range_m, render.projector_range_m[: rig.projector.rows]
    found = contradicting(rig, seen, lit)
    if found <= _REFUSED:
        return
    causes = {
        "the projector's images look mirrored left to right": (seen, lit[:, ::-1]),
        "the camera's images look mirrored left to right": (seen[:, ::-1], lit),
        "all images look mirrored left to right, as a left-handed export makes them, or the projector stands on the "
        "other side": (seen[:, ::-1], lit[:, ::-1]),
    }
    rates = {cause: contradicting(rig, *images) for cause, images in causes.items()}
    cause = min(rates, key=lambda each: rates[each])
    if rates[cause] > min(_FITTING, found / 3):
        cause = "is the projector's pose, its focal length or a unit another than set.toml and the rig say?"
    share = f"{100 * found:.0f} % of their points"
    raise BadSample(f"{where}: camera and projector contradict each other at {share}: {cause}")


def contradicting(rig: Rig, range_m: Ranges, projector_m: Ranges) -> float:
    """Share of a device's points that the other sees past, the larger of both ways; 0 of too few, 1 of none in view."""
    rotation, offset = rig.camera_to_projector()
    one, other = (rig.camera, range_m), (rig.projector, projector_m)
    ways = _seen_past(one, other, rotation, offset), _seen_past(other, one, rotation.T, -rotation.T @ offset)
    return 1.0 if ways == (None, None) else max(way or 0.0 for way in ways)


def _seen_past(
    one: tuple[Camera, Ranges], other: tuple[Camera, Ranges], rotation: NDArray[np.float64], offset: NDArray[np.float64]
) -> float | None:
    """As `contradicting`, of points of `one`; None if `other` has none in view. rotation, offset: from one to other."""
    (device, range_m), (target, target_m) = one, other
    rows, columns = np.nonzero(range_m)
    stride = max(1, len(rows) // _POINTS)
    rows, columns = rows[::stride], columns[::stride]
    points = device.points(range_m, rows, columns) @ rotation.T + offset
    points = points[points[:, 2] > 0]
    across, down = (points[:, :2] / points[:, 2:] * target.focal_px + target.centre_px).T
    inside = (across >= 0) & (across < target.columns) & (down >= 0) & (down < target.rows)
    if np.count_nonzero(inside) < _FEWEST:
        return None if len(rows) >= _FEWEST and not inside.any() else 0.0
    # The nearest surface in 3 x 3 pixels: at an edge either side will do; beyond the image lies nothing.
    padded = np.pad(np.where(target_m == 0, np.inf, target_m), 1)
    nearest = np.min([padded[y : y + target.rows, x : x + target.columns] for y in range(3) for x in range(3)], axis=0)
    seen = nearest[down[inside].astype(np.intp), across[inside].astype(np.intp)]
    return float(np.mean(seen > points[inside, 2] * (1 + _SLACK) + _SLACK))
