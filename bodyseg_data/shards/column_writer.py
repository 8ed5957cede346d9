"""Writer of a column: a plane or a field for all samples of a set that is there, whose files stay as they are."""

from __future__ import annotations

import contextlib
import json
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from bodyseg_data.core import BadConfig, BadSample, BadShard
from bodyseg_data.files import claimed, write_atomically
from bodyseg_data.samples import SampleInfo, kind_of
from bodyseg_data.shards.codecs import CODECS
from bodyseg_data.shards.columns import COLUMNS_NAME, column_file, column_names, column_tar
from bodyseg_data.shards.manifest import PLANE_KINDS, check_plane, manifest_bytes, read_manifest
from bodyseg_data.shards.records import Fields, ShardRecord
from bodyseg_data.shards.store import LocalFolder
from bodyseg_data.shards.tar import TarWriter


class ColumnWriter:
    """Writer of a further plane or field of every sample of a set, as a context manager.

        with ColumnWriter("shards", "instances", "uint16") as column:
            for key, instances in found:
                column.write(key, instances)

    folder: of the set. name: a lower-case word. kind: "uint8" or "uint16" for a plane; "text", "int", "float", "flag"
    or "numbers" for a field. The column is there when the block ends, all of it; after an error nothing is. Samples may
    come in any order; in the set's own, those of one shard are in memory at a time.

    Raises BadConfig for a name or kind that cannot be, or for a column that is there.
    """

    def __init__(self, folder: str | Path, name: str, kind: str) -> None:
        self._folder, self._name, self._kind = Path(folder), name, kind
        self._set = read_manifest(self._folder)
        self._is_plane = kind in PLANE_KINDS
        try:
            self._fields = Fields(() if self._is_plane else (((name, kind),),))
            if self._is_plane:
                check_plane(name, kind, str(folder))
        except BadShard as error:
            raise BadConfig(f"a column is of the kind {' or '.join(PLANE_KINDS)}, or a field: {error}") from error
        if name in (*self._set.planes, *self._set.fields.kinds):
            raise BadConfig(f"{folder}: the set itself has {name!r} already")
        if (self._folder / column_file(name)).exists():
            raise BadConfig(f"{folder} has the column {name!r}: delete {column_file(name)} to write it anew")
        shards = self._set.shards
        self._places = {key: (at, index) for at, shard in enumerate(shards) for index, key in enumerate(shard.keys)}
        self._held: list[dict[int, dict[str, bytes]]] = [{} for _ in shards]
        self._records: dict[int, ShardRecord] = {}

    def __enter__(self) -> ColumnWriter:
        self._claim = contextlib.ExitStack()
        self._claim.enter_context(claimed(self._folder, "ColumnWriter"))
        return self

    def write(self, key: str, value: Any) -> None:
        """Give a sample its plane, integers [H, W] as large as the set's images, or the value of its field.

        value: a NumPy array, a torch tensor or a plain value. Raises BadSample for a key that the set has not or that
        was written, or for a value of another kind or size; BadConfig if the disk cannot be written.
        """
        if key not in self._places:
            raise BadSample(f"column {self._name!r}: the set has no sample {key!r}")
        at, index = self._places[key]
        shard, held = self._set.shards[at], self._held[at]
        if at in self._records or index in held:
            raise BadSample(f"column {self._name!r}: {key} was written before")
        try:
            held[index] = self._plane(value) if self._is_plane else self._field(value, SampleInfo(shard.split))
        except BadSample as error:
            raise BadSample(f"{key}: {error}") from error
        if len(held) < len(shard):
            return
        path = self._folder / column_tar(shard.name, self._name)
        try:
            with TarWriter(path, path.with_name(f".{path.name}.part"), shard.split, self._fields) as tar:
                for number, each in enumerate(shard.keys):
                    tar.write(each, held.pop(number))
        except OSError as error:
            raise BadConfig(f"cannot write {path}: {error.strerror or error}") from error
        if tar.record is not None:
            self._records[at] = tar.record

    def _plane(self, value: Any) -> dict[str, bytes]:
        plane, kind, camera = np.asarray(value), np.dtype(self._kind), self._set.rig.camera
        shape = (camera.rows, camera.columns)
        if plane.dtype.kind not in "iu" or plane.shape != shape:
            raise BadSample(f"plane {self._name!r} must hold whole numbers {shape}, found {plane.dtype} {plane.shape}")
        if plane.min() < 0 or plane.max() > np.iinfo(kind).max:
            raise BadSample(f"plane {self._name!r} must be {kind}, found {plane.min()} to {plane.max()}")
        members = CODECS[self._set.codec].encode_plane(np.ascontiguousarray(plane, kind))
        return {f"plane.{self._name}.{ending}": data for ending, data in members.items()}

    def _field(self, value: Any, info: SampleInfo) -> dict[str, bytes]:
        value = value.tolist() if hasattr(value, "tolist") else value  # of NumPy or torch
        if self._kind == "numbers" and isinstance(value, list | tuple):
            value = tuple(float(each) if type(each) is int else each for each in value)
        value = float(value) if self._kind == "float" and type(value) is int else value
        if kind_of(value, self._name) != self._kind:
            raise BadSample(f"field {self._name!r} must be of the kind {self._kind}, found {value!r}")
        return {"json": json.dumps(info.with_fields(**{self._name: value}).to_json(), sort_keys=True).encode()}

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._claim:
            try:
                if kind is None:
                    self._finish()
                    self._records = {}
            finally:
                for record in self._records.values():
                    (self._folder / record.name).unlink(missing_ok=True)

    def _finish(self) -> None:
        """Write the column's manifest, and its name into the list. Raises BadSample if samples are missing."""
        lacking = [
            key for key, (at, index) in self._places.items() if at not in self._records and index not in self._held[at]
        ]
        if lacking:
            raise BadSample(
                f"column {self._name!r} must have every sample of the set: {len(lacking)} of {len(self._places)} are "
                f"missing, {lacking[0]} the first"
            )
        column = replace(
            self._set,
            rigs=(self._set.rig,),
            source="column",
            renderer="",
            plan=self._set.digest,
            shards=tuple(self._records[at] for at in range(len(self._records))),
            skipped=(),
            fields=self._fields,
            projector="none",
            planes={self._name: self._kind} if self._is_plane else {},
        )
        names = sorted({*column_names(LocalFolder(self._folder)), self._name})
        try:
            write_atomically(self._folder / column_file(self._name), manifest_bytes(column))
            write_atomically(self._folder / COLUMNS_NAME, json.dumps({"columns": names}).encode() + b"\n")
        except OSError as error:
            raise BadConfig(f"cannot write {self._folder}: {error.strerror or error}") from error
