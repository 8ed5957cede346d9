"""Writer of shards from scenes that exist: arrays go in one by one, shards and a manifest come out.

Scenes are checked where they are written and encoded by threads; shards of each split are cut in the order of writing.
While a writer is open, `OUT/.packing/` holds its state as a packing's does (`writing`), and `learned.json`, what the
first scene has shown of all: so a writer that was stopped carries on from its finished shards.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import shutil
import threading
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, Final, get_args

from bodyseg_data.core import BadConfig, BadSample, BodysegError, ProgressCallback, check_choice, check_int, silent
from bodyseg_data.files import write_atomically
from bodyseg_data.labels import Classes, LabelClass, classes_of
from bodyseg_data.packing.options import PACKING_VERSION
from bodyseg_data.packing.scene_layout import SceneLayout, facing_of, fields_of, learned_fields, learned_planes
from bodyseg_data.packing.writing import claimed, digest_of, finished_shards, record_shard, writing_into
from bodyseg_data.renders import ProjectorRanges, Render
from bodyseg_data.rigs import Rig, load_rig
from bodyseg_data.samples import SHADOW_THRESHOLDS, SPLITS, Split, check_key
from bodyseg_data.shards import (
    CODECS,
    EXTERNAL,
    FACING_FROM_RANGE,
    MANIFEST_FORMAT,
    MANIFEST_NAME,
    Manifest,
    ProjectorKind,
    ShardRecord,
    TarWriter,
    check_plane,
    check_rigs,
    encode_sample,
    read_manifest,
    shard_name,
    write_manifest,
)

_LEARNED: Final = "learned.json"

EMPTY_PART: Final = "no_scenes"
"""File in the folder of a part that got no scenes, which `join` leaves out."""

RigLike = Rig | str | Path
Encoded = tuple[Split, dict[str, bytes]]
"""Split of a scene and its members, extension -> bytes."""


class ShardWriter:
    """Writes scenes as a set of shards into the folder `out`:

        with ShardWriter("mine/", rig="rig.toml", classes=["floor", "arm"]) as out:
            out.write(key="scene-000", range_m=z, labels=classes, projector_range_m=p)

    rig: the rig, its name or its file; or a list of rigs, of which each scene names its own by number.
    classes: names or `LabelClass`es, in the order of their labels, or `Classes`.
    projector: what is stored of the projector's range: "shadow", as far as the shadow test with this rig needs it;
    "exact", as rendered; "none". planes: name -> "uint8" or "uint16", for further images. fields: name -> kind of the
    descriptions ("text", "int", "float", "flag", "numbers"). Where one of the three is None, the first scene decides.
    source: name of the origin, for cards. codec: by name. shard_samples: samples a shard.
    workers: threads that encode, 0 for none. executor: encodes in their place, for example that of a Dask client;
    `workers` is then how many of its workers are kept busy.
    part: (i, n) for the i-th of n writers, 0 <= i < n, each with its share of the scenes: it writes a set of its own in
    a folder of `out`, and `bodyseg join` makes one of all. progress: called with the number of scenes written, twice.

    The manifest is written when the context ends without an error. After an error finished shards stay, and the same
    writer with the same scenes carries on: scenes of finished shards are skipped. If the set was already whole and
    holds them all, a warning says that nothing was written. Raises BadConfig for an argument out of range, or if `out`
    holds something else or another writer is at work there; BadShard for rigs or planes that one set cannot have.
    """

    def __init__(
        self,
        out: str | Path,
        *,
        rig: RigLike | Sequence[RigLike],
        classes: Classes | Iterable[str | LabelClass],
        projector: ProjectorKind | None = None,
        planes: Mapping[str, str] | None = None,
        fields: Mapping[str, str] | None = None,
        source: str = "renders",
        codec: str = "bsi",
        shard_samples: int = 1080,
        workers: int = 2,
        executor: Executor | None = None,
        part: tuple[int, int] | None = None,
        progress: ProgressCallback = silent,
    ) -> None:
        check_choice("projector", projector, (*get_args(ProjectorKind), None))
        if not isinstance(source, str) or not source or not source.isprintable():
            raise BadConfig(f"source must be a name that can be printed, found {source!r}")
        if not isinstance(out, str | Path) or not str(out).strip():
            raise BadConfig(f"out must be the path of a folder of this machine, found {out!r}")
        for name, kinds in (("planes", planes), ("fields", fields)):
            if not isinstance(kinds, Mapping | None):
                raise BadConfig(f"{name} must give a kind for each name, found {kinds!r:.200}")
        several = list(rig) if isinstance(rig, Sequence) and not isinstance(rig, str) else [rig]
        if not several or not all(isinstance(each, RigLike) for each in several):
            raise BadConfig(f"a set needs at least one rig, a Rig or its name or file, found {rig!r:.100}")
        self._rigs = tuple(each if isinstance(each, Rig) else load_rig(each) for each in several)
        check_rigs(self._rigs, "rig")
        self._classes = classes_of(classes)
        self._projector, self._source, self._codec = projector, source, check_choice("the codec", codec, CODECS)
        for name, kind in (planes or {}).items():
            check_plane(name, kind, "planes")
        self._planes = None if planes is None else dict(planes)
        self._fields = None if fields is None else fields_of(fields, len(self._rigs))
        self._shard_samples = check_int("shard_samples", shard_samples, 1)
        self._workers = check_int("workers", workers, 0)
        self._out, self._is_part = Path(out) / part_name(*part) if part is not None else Path(out), part is not None
        self._progress = progress
        self._pool = executor
        self._layout: SceneLayout | None = None
        self._state: Path | None = None
        self._complete = False
        self._records: dict[str, ShardRecord] = {}
        self._names = {split: map(partial(shard_name, split), itertools.count()) for split in SPLITS}
        self._done = 0
        self._finished: dict[str, Path] = {}
        self._seen: set[str] = set()
        self._open: dict[Split, TarWriter] = {}
        self._waiting: deque[tuple[str, Callable[[], Encoded]]] = deque()
        self._failed: BaseException | None = None
        self._one_thread = threading.Lock()

    def __enter__(self) -> ShardWriter:
        description = self._described()
        self._digest = digest_of(description)
        with writing_into(self._out), contextlib.ExitStack() as context:
            whole = {**description, "shard_samples": self._shard_samples}
            self._state = context.enter_context(claimed(self._out, whole, self._digest))
            self._carry_on(self._state)
            if self._workers and self._pool is None:
                self._pool = ThreadPoolExecutor(self._workers)
                context.callback(self._pool.shutdown, cancel_futures=True)
            self._context = context.pop_all()
        return self

    def __contains__(self, key: str) -> bool:
        """True if a scene is already in a finished shard, so that it need not be rendered again."""
        return key in self._finished

    def finished(self) -> Mapping[str, Path]:
        """The scenes in shards that earlier runs finished: key -> file of the shard."""
        return self._finished

    def write(
        self,
        *,
        key: str,
        range_m: Any,
        labels: Any,
        projector_range_m: Any = None,
        projector: ProjectorRanges | None = None,
        facing: Any = None,
        normals: Any = None,
        split: Split = "train",
        fields: Mapping[str, Any] | None = None,
        planes: Mapping[str, Any] | None = None,
        rig: int = 0,
    ) -> bool:
        """Write one scene; False if a shard that an earlier run finished holds it already.

        Arrays are of NumPy or torch; the caller may use them again once this returns. Several threads may write.
        key: unique in the set, 1 to 80 letters, digits, "_", "+" and "-".
        range_m: floats [H, W], metres along the camera's axis, 0 where nothing was measured.
        labels: whole numbers [H, W], classes of the set, 254 on surfaces of none, 255 where nothing was measured.
        Stored is 255 exactly where `range_m` is 0: other labels there (as of a background) are dropped, and 255 on a
        surface becomes 254.
        projector_range_m: floats [Hp, Wp], likewise for the projector; of two, the second's rows below the first's.
        projector: in its place a function that takes rows and columns [N] of texels in that image and returns their
        ranges [N]. It is called once a projector, in this thread, and only for texels that the set needs.
        facing: bool [H, W], or [2, H, W] for two projectors: whether the surface is turned towards the projector.
        normals: in its place floats [H, W, 3], the outward normals in the camera's frame (x right, y down, z forward).
        Without both, facing is found from `range_m`; all scenes of a set do it alike.
        split: "train" or "test". fields: values of the description, some of the set's. planes: name -> whole numbers
        [H, W], all of the set's. rig: number of the scene's rig in the set's list.

        Raises BadSample, naming the key, for what breaks a rule: the scene is then not written, and the writer goes on.
        """
        images = range_m, labels, projector_range_m, facing, normals
        scene = Render(key, *images, split, fields or {}, planes or {}, rig, projector)
        with self._one_thread:
            if not self._is_new(key):
                return False
            layout = self._layout or self._learned(scene)
            taken = layout.taken(scene)
            if self._complete:
                found = f"{self._out} holds a finished set without it"
                raise BadConfig(f"{key}: {found}: choose another folder, or delete it")
            if self._layout is None:
                self._learn(layout)
            self._seen.add(key)
            self._enqueue(key, _encoded, layout, taken)
        return True

    def write_all(self, scenes: Mapping[str, Any], function: Callable[[Any], Mapping[str, Any]]) -> None:
        """Write scenes that a function makes where they are encoded: in the writer's threads or executor.

        scenes: key -> what the function needs to make the scene, such as a path. Those of finished shards are skipped.
        function: returns the arguments of `write`, without `key`. With an executor of processes or of a cluster, the
        function and what it is given must be picklable. Raises as `write`, but the writer then does not go on.
        """
        for key, reference in scenes.items():
            if not self._is_new(key):
                continue
            if self._layout is None or self._complete:
                self.write(key=key, **function(reference))  # in this thread: the first tells what all must have
            else:
                self._seen.add(key)
                self._enqueue(key, _made, self._layout, key, function, reference)

    def _is_new(self, key: str) -> bool:
        """False for a scene of a finished shard. Raises BadSample for a bad key, or one that was written before."""
        self._opened()
        if self._failed is not None:
            raise self._failed
        check_key(key if isinstance(key, str) else f"<{key!r}>")
        if key in self._seen:
            raise BadSample(f"{key}: this key was written before")
        if key in self._finished:
            self._seen.add(key)
            return False
        return True

    def _enqueue(self, key: str, work: Callable[..., Encoded], *given: Any) -> None:
        """Begin to encode a scene; while more than two a worker are under way, append the first of them."""
        result = partial(work, *given) if self._pool is None else self._pool.submit(work, *given).result
        self._waiting.append((key, result))
        while len(self._waiting) > 2 * self._workers:
            self._append_next()

    def _append_next(self) -> None:
        """Append the scene that was written first of those under way to its shard."""
        key, result = self._waiting.popleft()
        try:
            encoded = result()  # apart: a file that the user's function lacks is no fault of the set's folder
            with writing_into(self._out):
                self._append(key, *encoded)
        except BaseException as error:
            self._failed = error  # the scene is lost, so the set cannot be finished
            raise
        self._done += 1
        self._progress(self._done, self._done)

    def _append(self, key: str, split: Split, members: Mapping[str, bytes]) -> None:
        state, layout = self._opened(), self._layout
        if split not in self._open and layout is not None:
            name = next(name for name in self._names[split] if name not in self._records)
            (self._out / MANIFEST_NAME).unlink(missing_ok=True)
            self._open[split] = TarWriter(self._out / name, state / f"{name}.part", split, layout.fields).__enter__()
        self._open[split].write(key, members)
        if len(self._open[split]) == self._shard_samples:
            self._close(split)

    def _close(self, split: Split) -> None:
        writer = self._open.pop(split)
        writer.__exit__(None, None, None)
        self._records[writer.record.name] = writer.record
        record_shard(self._opened(), writer.record)

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, *_: object) -> None:
        try:
            if error is None:
                while self._waiting:
                    self._append_next()
                with writing_into(self._out):
                    self._finish()
        finally:
            for writer in self._open.values():
                writer.__exit__(KeyboardInterrupt, None, None)  # as after any error: its file goes
            self._open.clear()
            self._waiting.clear()
            if (self._out / MANIFEST_NAME).exists():  # the set is whole, perhaps since before
                shutil.rmtree(self._opened(), ignore_errors=True)
            self._state = None
            self._context.close()
        if error is None and self._complete and self._seen:
            anew = "to write them anew, delete it or give another folder"
            warnings.warn(f"nothing was written: {self._out} held a finished set with all scenes; {anew}", stacklevel=2)

    def _finish(self) -> None:
        """Write the manifest."""
        if self._failed is not None:
            raise self._failed
        for split in list(self._open):
            self._close(split)
        if self._layout is None or not self._records:
            if not self._is_part:
                raise BadConfig(f"no scene was written: {self._out} gets no manifest")
            write_atomically(self._out / EMPTY_PART, b"")
            return
        if not (self._out / MANIFEST_NAME).exists():  # else nothing was written
            layout, records = self._layout, self._records.values()
            manifest = Manifest(
                rigs=layout.rigs,
                codec=layout.codec,
                source=self._source,
                renderer=layout.facing,
                plan=self._digest,
                shards=sorted(records, key=lambda each: (SPLITS.index(each.split), len(each.name), each.name)),
                classes=layout.classes,
                fields=layout.fields,
                projector=layout.projector,
                planes=layout.planes,
            )
            write_manifest(manifest, self._out)

    def _described(self) -> dict[str, Any]:
        """Everything that shapes the bytes of a sample, as far as known before the first scene, as plain JSON."""
        return {
            "format": MANIFEST_FORMAT,
            "version": PACKING_VERSION,
            "rigs": [rig.to_json() for rig in self._rigs],
            "classes": self._classes.to_json(),
            "projector": self._projector,
            "planes": self._planes,
            "fields": None if self._fields is None else self._fields.to_json(),
            "source": self._source,
            "codec": self._codec,
            "shadow_thresholds": asdict(SHADOW_THRESHOLDS),
        }

    def _learned(self, scene: Render) -> SceneLayout:
        """The layout of all samples: what the user did not give is taken from the first scene."""
        fields = self._fields or learned_fields(scene.fields, len(self._rigs), scene.key)
        planes = learned_planes(scene.planes, scene.key) if self._planes is None else self._planes
        unseen = scene.projector is None and scene.projector_range_m is None
        projector: ProjectorKind = self._projector or ("none" if unseen else "shadow")
        return SceneLayout(self._rigs, self._classes, fields, projector, planes, facing_of(scene), self._codec)

    def _learn(self, layout: SceneLayout) -> None:
        self._layout = layout
        stored = {"fields": layout.fields.kinds, "projector": layout.projector, "planes": dict(layout.planes)}
        with writing_into(self._out):
            write_atomically(self._opened() / _LEARNED, json.dumps({**stored, "facing": layout.facing}).encode())
            (self._out / EMPTY_PART).unlink(missing_ok=True)

    def _carry_on(self, state: Path) -> None:
        """Find the shards that an earlier run finished, and what it had learned."""
        if (self._out / MANIFEST_NAME).exists():
            manifest = read_manifest(self._out)
            known = manifest.fields, manifest.projector, manifest.planes, manifest.renderer
            names = [record.name for record in manifest.shards]
        else:
            try:
                stored = json.loads((state / _LEARNED).read_bytes())
                fields = fields_of(stored["fields"], len(self._rigs))
                known = fields, stored["projector"], dict(stored["planes"]), stored["facing"]
                facings = EXTERNAL, FACING_FROM_RANGE
                if stored["projector"] not in get_args(ProjectorKind) or stored["facing"] not in facings:
                    raise ValueError("a value that no writer has stored")
            except FileNotFoundError:
                return  # no scene was written
            except (OSError, ValueError, LookupError, TypeError, AttributeError, BodysegError) as error:
                raise BadConfig(f"{state / _LEARNED} cannot be read: delete {self._out} and write it again") from error
            names = sorted(path.name.removesuffix(".json") for path in state.glob("*.tar.json"))
        layout = SceneLayout(self._rigs, self._classes, *known, self._codec)
        self._learn(layout)
        self._records = finished_shards(self._out, state, names, layout.fields)
        self._finished = {key: self._out / name for name, record in self._records.items() for key in record.keys}
        self._done = len(self._finished)
        self._complete = (self._out / MANIFEST_NAME).exists() and len(self._records) == len(names)
        self._layout = layout if self._records else None

    def _opened(self) -> Path:
        """The folder of the state."""
        if self._state is None:
            raise BadConfig("a ShardWriter writes in a with statement: with ShardWriter(...) as out")
        return self._state


def _encoded(layout: SceneLayout, taken: Render) -> Encoded:
    return taken.split, encode_sample(layout.sample(taken), layout.codec)


def _made(layout: SceneLayout, key: str, function: Callable[[Any], Mapping[str, Any]], reference: Any) -> Encoded:
    return _encoded(layout, layout.taken(Render(key, **function(reference))))


def part_name(number: int, count: int) -> str:
    """Name of the folder of a part's set. Raises BadConfig unless it is one of the parts, counted from 0."""
    if not 0 <= check_int("part", number, 0) < check_int("parts", count, 1):
        raise BadConfig(f"part must be (i, n), i from 0 to n - 1, found ({number}, {count})")
    return f"part-{number:05d}-of-{count:05d}"
