"""Writer and reader of shards: plain tars, readable by WebDataset, written atomically, read by offset and checked."""

from __future__ import annotations

import contextlib
import hashlib
import os
import tarfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import IO, Any, Final

from numpy.typing import NDArray

from bodyseg_data.core import BadSample, BadShard, one_line, reported
from bodyseg_data.files import sync
from bodyseg_data.labels import UNLABELLED
from bodyseg_data.rigs import Rig
from bodyseg_data.samples import Sample, SampleInfo, Split, check_key
from bodyseg_data.shards.codecs import CODECS
from bodyseg_data.shards.codecs.codec import OutputArrays
from bodyseg_data.shards.index import encode_piece
from bodyseg_data.shards.manifest import Manifest
from bodyseg_data.shards.records import BLOCK, BODY_FIELDS, Entry, Fields, ShardRecord, describe, location, read_checked
from bodyseg_data.shards.sample_codec import decode_sample, parse_info
from bodyseg_data.shards.store import TALLY, Stage, Store, store_at


class TarWriter:
    """Writer of one shard to the file `aside`, which is renamed to `path` on success and removed after an error.

    Owners, modes and times in the tar are fixed, so the same samples give the same bytes. fields: of descriptions in
    the set. record: the shard's record, once it is closed. Raises BadShard for one too large for an index.
    """

    record: ShardRecord

    def __init__(self, path: Path, aside: Path, split: Split, fields: Fields = BODY_FIELDS) -> None:
        self._path, self._aside, self._split, self._fields = path, aside, split, fields
        self._sha256 = hashlib.sha256()
        self._size = 0
        self._entries: list[Entry] = []
        self._notes: list[str] = []
        self._infos: list[SampleInfo] = []

    def __enter__(self) -> TarWriter:
        self._file: IO[bytes] = self._aside.open("wb")
        return self

    def __len__(self) -> int:
        """Number of samples written."""
        return len(self._entries)

    def write(self, key: str, members: Mapping[str, bytes]) -> None:
        """Append one sample. members: extension -> bytes, `json` among them where the set has fields.

        Raises BadSample for a key unfit for file names, or a description that cannot be read.
        """
        check_key(key)
        described = "json" in members or self._fields.kinds
        self._infos.append(parse_info(members.get("json", b""), key) if described else SampleInfo(self._split))
        data = b"".join(_member(f"{key}.{extension}", members[extension]) for extension in sorted(members))
        self._entries.append(Entry(key, self._size, len(data), zlib.crc32(data)))
        self._append(data)

    def note(self, mesh: str, notes: Sequence[str]) -> None:
        """Add notes on a mesh to the shard's record; see `ShardRecord.notes`."""
        self._notes.extend(one_line(f"{mesh}: {note}") for note in notes)

    def _append(self, data: bytes) -> None:
        self._file.write(data)
        self._sha256.update(data)
        self._size += len(data)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is None:
                # Two empty blocks end an archive, which is padded to whole records.
                whole = -(-(self._size + 2 * BLOCK) // tarfile.RECORDSIZE) * tarfile.RECORDSIZE
                self._append(bytes(whole - self._size))
                self._file.flush()
                os.fsync(self._file.fileno())
                self._file.close()
                keys, offsets, lengths, crc32 = zip(*self._entries, strict=True)
                self.record = ShardRecord(
                    name=self._path.name,
                    split=self._split,
                    size=self._size,
                    sha256=self._sha256.hexdigest(),
                    keys=keys,
                    offsets=offsets,
                    lengths=lengths,
                    crc32=crc32,
                    notes=tuple(self._notes),
                    descriptions=describe(self._infos, self._fields),
                )
                encode_piece(self.record)  # else an index of all would not be written, at the end of a long packing
                self._aside.replace(self._path)
                sync(self._path.parent)
        finally:
            # Closing flushes, which fails again on a full disk; unless it was renamed, the file is removed in any case.
            with contextlib.suppress(OSError):
                self._file.close()
            self._aside.unlink(missing_ok=True)


def _member(name: str, data: bytes) -> bytes:
    return _header(name, len(data)) + data + bytes(-len(data) % BLOCK)


def _header(name: str, size: int) -> bytes:
    """Encode a tar header without any time or owner."""
    header = tarfile.TarInfo(name)
    header.size, header.mode, header.mtime = size, 0o644, 0
    return header.tobuf(tarfile.USTAR_FORMAT)


_NAMELESS: Final = _header("", 0)
_OWNERS, _TIME, _END = _NAMELESS[100:124], _NAMELESS[135:148], _NAMELESS[154:]
_REST: Final = int(_NAMELESS[148:154], 8) - sum(b"0" * 11)
"""Contribution to the checksum of all header bytes except the name and the digits of the size."""


def _read_header(block: bytes) -> tuple[str, bytes, int]:
    """Parse name, type and size of a tar header. Raises tarfile.HeaderError or UnicodeDecodeError."""
    name, digits = block[:100].rstrip(b"\0"), block[124:135]
    # Headers that equal those of `_header` in all bits: tarfile would take a fifth of the time of decoding for them.
    fixed = block[100:124] == _OWNERS and block[135:148] == _TIME and block[154:] == _END
    if (
        fixed
        and block[148:154] == b"%06o" % (_REST + sum(name) + sum(digits))
        and name.isascii()
        and b"\0" not in name
        and not digits.strip(b"01234567")
    ):
        return name.decode("ascii"), tarfile.REGTYPE, int(digits, 8)
    header = tarfile.TarInfo.frombuf(block, "utf-8", "strict")
    return header.name, header.type, header.size


class ShardReader:
    """Reader of single samples by their index in the manifest, with what columns have for them, all checked by CRC-32.

    It keeps no open file, so it may be forked, pickled and used by several threads; opening a file for each sample
    takes a hundredth of the time of decoding.
    """

    def __init__(
        self, where: Path | Store, manifest: Manifest, columns: Mapping[str, Manifest] = MappingProxyType({})
    ) -> None:
        self.store, self._manifest, self._columns = store_at(where), manifest, dict(columns)

    def read(
        self,
        shard: int,
        index: int,
        projector: bool = True,
        out: OutputArrays | None = None,
        unlabelled: int = UNLABELLED,
        planes: Sequence[str] | None = None,
    ) -> Sample:
        """Read sample `index` of shard number `shard`. projector, out, unlabelled, planes: see `decode_sample`.

        Raises BadShard, naming shard, key and offset, for bytes that are missing, altered or no sample of the set's
        rig; Unreachable if a remote set cannot be reached.
        """
        (key, members), rig = self.members(shard, index), self._manifest.rig
        try:
            sample = decode_sample(
                key,
                members,
                projector=projector,
                out=out,
                projectors=len(rig.projectors),
                unlabelled=unlabelled,
                planes=planes,
            )
            check_sizes(sample, rig)
            TALLY.lap(Stage.DECODE)
        except BadSample as error:
            raise BadShard(f"{location(self._manifest.shards[shard], index)}: {error}") from error
        for name, column in self._columns.items():
            self._join(sample, name, column, (shard, index), planes is None or name in planes)
        return sample

    def _join(self, sample: Sample, name: str, column: Manifest, place: tuple[int, int], wanted: bool) -> None:
        """Give a sample what a column has for it: its field or, if it is wanted, its plane."""
        record, index = column.shards[place[0]], place[1]
        if not column.planes:
            info = sample.info.with_fields(**record.descriptions.info(index, record.split).fields)
            vars(sample).update(info=info)
        elif wanted:
            with reported(location(record, index), BadShard, BadSample):
                plane = decode_piece(column, sample.key, read_checked(self.store, record, index))
            vars(sample).update(planes={**sample.planes, name: plane})

    def members(self, shard: int, index: int) -> tuple[str, dict[str, bytes]]:
        """Read the key and the members, extension -> bytes, of a sample, which is not decoded. Raises as `read`."""
        record = self._manifest.shards[shard]
        data, key = read_checked(self.store, record, index), record.entry(index).key
        try:  # not `reported`, whose words would be made for every sample
            return key, parse_members(key, data)
        except BadSample as error:
            raise BadShard(f"{location(record, index)}: {error}") from error


def decode_piece(column: Manifest, key: str, data: bytes) -> NDArray[Any]:
    """Decode a sample of a column of planes. Raises BadSample, naming the key, unless it holds that plane alone."""
    ((name, kind),) = column.planes.items()
    members = parse_members(key, data)
    found = [member for member in members if member.startswith(f"plane.{name}.")]
    if len(members) != 1 or not found:
        raise BadSample(f"{key}: a column holds plane.{name} alone, found {', '.join(members) or 'nothing'}")
    with reported(f"{key}: {found[0]}", BadSample, ValueError):
        plane = CODECS[column.codec].decode_plane(members[found[0]])
    shape = (column.rig.camera.rows, column.rig.camera.columns)
    if plane.dtype.name != kind or plane.shape != shape:
        raise BadSample(f"{key}: plane {name!r} must be {kind} {shape}, found {plane.dtype} {plane.shape}")
    return plane


def parse_members(key: str, data: bytes) -> dict[str, bytes]:
    """Parse a sample's tar members: extension -> bytes. Raises BadSample unless they are plain files named by `key`."""
    members: dict[str, bytes] = {}
    position, end = 0, len(data)
    while position < end:
        try:
            name, kind, size = _read_header(data[position : position + BLOCK])
        except (tarfile.HeaderError, UnicodeDecodeError) as error:
            raise BadSample(f"{key}: no tar header at byte {position} of the sample: {error}") from error
        stem, _, extension = name.partition(".")
        # `isreg` would accept sparse files.
        if kind != tarfile.REGTYPE or stem != key or not extension or extension in members:
            raise BadSample(f"{key}: a sample holds plain files called {key}.*, once each, found {name!r}")
        start = position + BLOCK
        if not 0 <= size <= end - start:
            raise BadSample(f"{key}: {name} claims {size} bytes, the sample ends before")
        members[extension] = data[start : start + size]
        position = start + -(-size // BLOCK) * BLOCK
    return members


def check_sizes(sample: Sample, rig: Rig) -> None:
    """Raise BadSample unless the images have the rows and columns of the rig's camera and projectors."""
    camera = rig.camera.rows, rig.camera.columns
    images: list[tuple[str, NDArray[Any] | None, tuple[int, int]]] = [
        ("range", sample.range, camera),
        ("labels", sample.labels, camera),
        ("faces_projector", sample.faces_projector, camera),
        ("projector_range", sample.projector_range, rig.projector_shape),
        *((f"plane {name}", plane, camera) for name, plane in sample.planes.items()),
    ]
    for field, image, size in images:
        if image is not None and image.shape != size:
            raise BadSample(f"{sample.key}: {field} must be {size[0]} x {size[1]} as in the rig, found {image.shape}")
