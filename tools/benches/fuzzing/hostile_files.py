"""Whole files made to break readers: samples of a tar, manifests, indices, rigs, renders, landmarks, meshes.

Samples, manifests and indices are of today's format and of each earlier one that is read.
"""

from __future__ import annotations

import hashlib
import io
import json
import struct
import tarfile
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from PIL import Image

from benches.data.codec.earlier import earlier_images, earlier_pngs
from benches.fuzzing.hostile import hostile_image, hostile_json, hostile_png, hostile_tree, one_of, spoiled
from bodyseg_data.labels import LANDMARKS, UNLABELLED, LabelClass, classes_of
from bodyseg_data.rigs import load_rig
from bodyseg_data.samples import SPLITS, Sample, SampleInfo, Value
from bodyseg_data.shards import BODY_FIELDS, CODECS, CodecName, Fields, Manifest, ShardRecord, column_tar, encode_sample
from bodyseg_data.shards.codecs.png import encode_png
from bodyseg_data.shards.earlier import EARLIER_FORMATS
from bodyseg_data.shards.index import encode_piece, write_index
from bodyseg_data.shards.records import describe

KEY: Final = "open-A-posture-00-d215-a040"
"""The key that hostile samples are read under."""

_TYPES: Final = (*(b"%d" % number for number in range(8)), *(bytes([code]) for code in b"\0SLKxgXNDMVA\xff"))
_NAMES: Final = (
    *(b"../" + KEY.encode() + b".json", b"/" + KEY.encode() + b".json", KEY.encode(), KEY.encode() + b"."),
    *(KEY.encode() + b".json\0../x", KEY.encode() + b"/.json", KEY.encode() + b".json/", b"", b"\xff\xfe.json"),
    *(b"././@LongLink", b"x" * 100, KEY.encode() + b".range.bsi", KEY.encode() + b".json"),
)
_SIZES: Final = (
    *(b"00000000000\0", b"77777777777\0", b"-0000000001\0", b"            ", b"\0" * 12, b"9999\0"),
    *(b"0x10\0", b"1_0\0"),
    *(b"\x80" + b"\xff" * 11, b"\x80" + b"\0" * 10 + b"\1", b"\xff" * 12, b"\xff" + b"\0" * 11, b"\x80" + b"\0" * 11),
)
_FIELDS: Final = ((0, 100), (100, 8), (108, 8), (116, 8), (136, 12), (257, 8), (329, 8), (345, 155), (386, 126))


def _info(mesh: str) -> SampleInfo:
    """A description as sets of bodies have it."""
    fields: dict[str, Value] = dict.fromkeys(("source", "subset", "subject", "mesh", "pose", "things"), mesh)
    numbers: dict[str, Value] = dict.fromkeys(("distance_cm", "azimuth_deg", "pitch_deg", "roll_deg", "height_cm"), 40)
    return SampleInfo("train", {**fields, **numbers, "hidden_pct": 0})


@lru_cache(maxsize=4)
def _samples(codec: CodecName) -> list[dict[str, bytes]]:
    """Small valid samples: a slope that faces now and then, nothing at all, all body, one pixel, noise, each as today
    and as formats before 7 had it; and with what they had not: further planes, a smooth projector's range, and none.
    """
    generator = np.random.default_rng(1)
    slope = (20_000 + np.add.outer(np.arange(48) * 7, np.arange(33) * 3)).astype(np.uint16)
    framed = np.zeros((64, 50), np.uint16)
    framed[6:54, 9:42] = slope
    framed[20:30, 12:20] = 0
    noise = generator.integers(0, 65536, (23, 17)).astype(np.uint16)
    found = []
    for ranges in (framed, np.zeros((5, 9), np.uint16), slope, np.full((1, 1), 65535, np.uint16), noise):
        labels = np.where(ranges > 0, ranges // 700 % 33, 255).astype(np.uint8)
        labels[ranges % 11 == 5] = UNLABELLED
        facing = ((ranges // 9) % 2 > 0) & (ranges > 0)
        sample = Sample(KEY, ranges, ranges[::-1] // 2, labels, facing, _info("posture-00"))
        found.append(encode_sample(sample, codec))
        images = {"bsi": earlier_images(sample)} if codec == "bsi" else earlier_pngs(sample)
        found.append({"json": found[-1]["json"], **images})
    planes: dict[str, NDArray[Any]] = {"instances": framed // 300, "template": (framed // 500).astype(np.uint8)}
    labels = np.where(framed > 0, np.uint8(253), np.uint8(255))
    for projector in (slope, None):
        whole = Sample(KEY, framed, projector, labels, framed > 0, _info("posture-00"), planes=planes)
        found.append(encode_sample(whole, codec))
    return found


def _members(codec: CodecName, generator: Generator) -> dict[str, bytes]:
    return dict(one_of(_samples(codec), generator))


def _hostile_member(members: dict[str, bytes], name: str, generator: Generator) -> bytes:
    return (hostile_png if name.endswith("png") else hostile_image)(members[name], generator)


def hostile_bsi(generator: Generator) -> dict[str, bytes]:
    """A sample whose images, in the package's own codec, are hostile, and its further planes, too."""
    members = _members("bsi", generator)
    return members | {name: _hostile_member(members, name, generator) for name in members if name != "json"}


def hostile_pngs(generator: Generator) -> dict[str, bytes]:
    """A sample one of whose PNGs is hostile."""
    members = _members("png", generator)
    name = one_of([name for name in members if name != "json"], generator)
    return members | {name: _hostile_member(members, name, generator)}


def hostile_sample(generator: Generator) -> dict[str, bytes]:
    """Members of a sample: other bytes or JSON in one of them, one missing, too many, of two codecs or samples."""
    codec = one_of(list(CODECS), generator)
    members, other = _members(codec, generator), _members(codec, generator)
    names = list(members)
    name = one_of(names, generator)
    match int(generator.integers(7)):
        case 0:
            return members
        case 1:
            members[name] = spoiled(members[name], generator)
        case 2 | 3:
            members["json"] = json.dumps(hostile_tree(json.loads(members["json"]), generator)).encode()
        case 4:
            members["json"] = hostile_json(members["json"].decode(), generator)
        case 5:
            members[str(generator.choice((*names, "extra", "range.gif", "", ".", "bsi.png")))] = members.pop(name)
        case _:
            members[name] = one_of([*other.values()], generator)
    return members


def hostile_tar(generator: Generator) -> bytes:
    """The bytes of one sample in a tar: links, devices, sparse files, long names, tricks with paths and sizes."""
    members = _members("bsi", generator)
    headers = []
    for extension in sorted(members):
        header = tarfile.TarInfo(f"{KEY}.{extension}")
        header.size = len(members[extension])
        headers.append((bytearray(header.tobuf(tarfile.USTAR_FORMAT)), members[extension]))
    for _ in range(int(generator.integers(1, 3))):
        header_bytes, data = one_of(headers, generator)
        match int(generator.integers(8)):
            case 0:
                header_bytes[156:157] = one_of(_TYPES, generator)
            case 1:
                header_bytes[:100] = one_of(_NAMES, generator).ljust(100, b"\0")
            case 2 | 3:
                header_bytes[124:136] = one_of(_SIZES, generator).ljust(12, b"\0")
            case 4:
                offset, length = one_of(_FIELDS, generator)
                header_bytes[offset : offset + length] = generator.bytes(length)
            case 5:
                header_bytes[:] = spoiled(bytes(header_bytes), generator)[:512].ljust(512, b"\0")
            case 6:
                headers.insert(int(generator.integers(len(headers) + 1)), _long_name(generator))
            case _:
                headers.append((bytearray(header_bytes), data))
        _sum_set(header_bytes)
    whole = b"".join(bytes(header) + data + bytes(-len(data) % 512) for header, data in headers)
    return whole if generator.integers(4) else spoiled(whole, generator)


def _long_name(generator: Generator) -> tuple[bytearray, bytes]:
    """A member of another dialect that renames, or resizes, the one behind it."""
    kinds = (tarfile.XHDTYPE, tarfile.XGLTYPE, tarfile.GNUTYPE_LONGNAME, tarfile.GNUTYPE_LONGLINK)
    kind = one_of(kinds, generator)
    headers = (b"30 path=../../../etc/passwd\n", b"18 size=99999999\n", b"24 GNU.sparse.major=1\n", b"../x\0")
    data = one_of(headers, generator)
    header = tarfile.TarInfo(f"{KEY}.x")
    header.type, header.size = kind, len(data)
    return bytearray(header.tobuf(tarfile.USTAR_FORMAT)), data


def _sum_set(header: bytearray) -> None:
    header[148:156] = b" " * 8
    header[148:156] = b"%06o\0 " % sum(header)


@lru_cache(maxsize=1)
def _records() -> tuple[ShardRecord, ...]:
    keys = tuple(f"open-A-posture-0{number}-d215-a040" for number in range(3))
    infos = [_info(f"posture-0{number}") for number in range(3)]
    return tuple(
        ShardRecord(
            name=f"{split}-00000.tar",
            split=split,
            size=20480,
            sha256="0" * 64,
            keys=named,
            offsets=(0, 4096, 8192),
            lengths=(4096,) * 3,
            crc32=(1, 2, 3),
            notes=("a: noted",),
            descriptions=describe(infos, BODY_FIELDS),
        )
        for split, named in zip(SPLITS, (keys, tuple(key.replace("-A-", "-B-") for key in keys)), strict=True)
    )


@lru_cache(maxsize=1)
def _manifest_trees() -> list[dict[str, Any]]:
    """Manifests without their digests: of bodies, of other classes, fields and planes, of format 5, with an index of
    today and of format 6.
    """
    records = _records()
    bodies = Manifest((load_rig(),), "bsi", "open", "raster", "0" * 64, records)
    pair = (LabelClass("left", "right", "#1e90ff", "hand"), LabelClass("right", "left"), LabelClass("table"))
    fields = Fields(((("rig", "int"), ("pose", "numbers"), ("robot", "text")), (("reach_m", "float"), ("wet", "flag"))))
    values: dict[str, Value] = {"rig": 1, "pose": (1.0, 0.5), "robot": "r1", "reach_m": 2.5, "wet": False}
    other = replace(
        bodies,
        rigs=2 * bodies.rigs,
        classes=classes_of(pair),
        fields=fields,
        projector="exact",
        planes={"instances": "uint16"},
        shards=[replace(each, descriptions=describe(3 * [SampleInfo("train", values)], fields)) for each in records],
    )
    with tempfile.TemporaryDirectory() as folder:
        table = write_index(records, Path(folder))
    trees = [bodies.to_json(), other.to_json(), {**bodies.to_json(), "shards": table.to_json()}]
    for tree in trees:
        del tree["digest"]
    kept = {name: trees[0][name] for name in ("codec", "source", "renderer", "plan")}
    earlier = {**kept, "parts": list(LANDMARKS), "rig": trees[0]["rigs"][0]}
    described = ("bodies", "views", "body", "view")
    for tree in (trees[0], trees[2]):
        shards = tree["shards"]
        if isinstance(shards, list):
            shards = [
                {name: value for name, value in shard.items() if name not in ("tables", "rows")}
                | dict(zip(described, (*shard["tables"][:2], *shard["rows"][:2]), strict=True))
                for shard in shards
            ]
        trees.append({**earlier, "format": EARLIER_FORMATS[tree is trees[2]], "shards": shards})
    return trees


def hostile_manifest(generator: Generator) -> bytes:
    """A manifest: spoiled as text, or with other content under the right digest."""
    if generator.integers(3) == 0:
        return hostile_json(json.dumps(_signed(one_of(_manifest_trees(), generator)), sort_keys=True), generator)
    tree = hostile_tree(one_of(_manifest_trees(), generator), generator)
    if not isinstance(tree, dict):
        return json.dumps(tree).encode()
    signed = _signed(tree)
    if generator.integers(10) == 0:
        signed["digest"] = hostile_tree([0], generator)
    return json.dumps(signed, sort_keys=True).encode() + b"\n"


def hostile_piece(generator: Generator) -> tuple[bool, bytes]:
    """A shard's piece of an index, spoiled or with other numbers or text; and whether it is one of format 6."""
    earlier = bool(generator.integers(3) == 0)
    record = _records()[0]
    piece = _earlier_piece(record) if earlier else encode_piece(record)
    head, brace, text = piece.partition(b"{")
    match int(generator.integers(5)):
        case 0:
            return earlier, piece
        case 1:
            return earlier, spoiled(piece, generator)
        case 2:  # other numbers, of any kind, before the text
            return earlier, spoiled(head, generator) + brace + text
        case 3:
            other = hostile_json((brace + text).decode(), generator)
        case _:
            other = json.dumps(hostile_tree(json.loads(brace + text), generator), sort_keys=True).encode()
    if not earlier:  # whose length stands in the header
        head = head[:8] + struct.pack("<I", len(other)) + head[12:]
    return earlier, head + other


def _earlier_piece(record: ShardRecord) -> bytes:
    """A piece of an index as format 6 had it (`bodyseg_data/shards/earlier.py`)."""
    piece = json.loads(b"{" + encode_piece(record).partition(b"{")[2])
    (bodies, views, *_), rows = piece["tables"], record.descriptions.rows
    text = {"bodies": bodies, **{name: piece[name] for name in ("stems", "tails", "notes")}}
    blocks = np.array([*record.offsets, record.offsets[-1] + record.lengths[-1]]) // 512
    text_bytes = json.dumps(text, sort_keys=True, separators=(",", ":")).encode()
    columns = [np.array(blocks, "<u4"), np.array(record.crc32, "<u4"), *(np.array(each, "u1") for each in rows[:2])]
    head = struct.pack("<4I", len(record), len(bodies[0]), len(views[0]), len(text_bytes))
    return head + b"".join(each.tobytes() for each in (*columns, np.array(views, "<i2").T)) + text_bytes


def _signed(tree: dict[str, Any]) -> dict[str, Any]:
    try:
        text = json.dumps(tree, sort_keys=True, separators=(",", ":"))
    except (RecursionError, ValueError):
        return tree
    return {**tree, "digest": hashlib.sha256(text.encode()).hexdigest()}


@lru_cache(maxsize=1)
def _rig_text() -> str:
    return (resources.files("bodyseg_data.rigs") / "paper.toml").read_text(encoding="utf-8")


@lru_cache(maxsize=1)
def column_set() -> Manifest:
    """The set that hostile columns are of."""
    return Manifest((load_rig(),), "bsi", "open", "raster", "0" * 64, _records())


@lru_cache(maxsize=1)
def _column_trees() -> list[tuple[str, dict[str, Any]]]:
    """Names and manifests without their digests of columns: a plane and a field."""
    found = []
    whole, no_fields, age = column_set(), Fields(()), Fields(((("age", "numbers"),),))
    for name, fields, values in (("instances", no_fields, {}), ("age", age, {"age": (1.0, 2.5)})):
        shards = [
            replace(
                record,
                name=column_tar(record.name, name),
                notes=(),
                descriptions=describe(3 * [SampleInfo(record.split, values)], fields),
            )
            for record in whole.shards
        ]
        planes = {} if values else {name: "uint16"}
        column = replace(whole, plan=whole.digest, planes=planes, fields=fields, projector="none", shards=shards)
        tree = column.to_json()
        del tree["digest"]
        found.append((name, tree))
    return found


def hostile_column(generator: Generator) -> tuple[str, bytes]:
    """The name of a column of `column_set`, and its file: spoiled as text, or with other content under its digest."""
    name, tree = one_of(_column_trees(), generator)
    match int(generator.integers(4)):
        case 0:
            return name, json.dumps(_signed(tree), sort_keys=True).encode()
        case 1:
            return name, hostile_json(json.dumps(_signed(tree), sort_keys=True), generator)
        case _:
            changed = hostile_tree(tree, generator)
            signed = _signed(changed) if isinstance(changed, dict) else changed
            return name, json.dumps(signed, sort_keys=True).encode()


_SET: Final = """format = "bodyseg renders 1"
classes = ["floor", "#1e90ff arm", "bin"]
first_label = 1
background = [0]
unit_m = 0.001
split = "train"
rig = "kinect_v1"
no_range = [9999]
"""


@lru_cache(maxsize=1)
def _renders() -> dict[str, bytes]:
    """A folder of renders: name of a file -> bytes."""
    ranges = np.zeros((480, 640), np.uint16)
    ranges[100:300, 200:500] = 2000 + np.arange(300)
    labels = np.where(ranges > 0, 1 + ranges % 3, 0).astype(np.uint8)
    as_numpy = io.BytesIO()
    np.save(as_numpy, ranges.astype(np.float32))
    rows = "".join(json.dumps({"key": key, "split": "train", "boxes": 3, "wet": True}) + "\n" for key in "ab")
    return {
        "set.toml": _SET.encode(),
        "samples.jsonl": rows.encode(),
        "range/a.png": encode_png(ranges),
        "range/b.npy": as_numpy.getvalue(),
        **{f"labels/{key}.png": encode_png(labels) for key in "ab"},
    }


def hostile_renders(generator: Generator) -> dict[str, bytes]:
    """A folder of renders one of whose files is spoiled, of other values, or away."""
    files = dict(_renders())
    name = str(generator.choice(list(files)))
    data = files[name]
    match int(generator.integers(6)):
        case 0:
            return files
        case 1:
            del files[name]
        case 2 if name.endswith("png"):
            files[name] = hostile_png(data, generator)
        case 2 | 3 if name == "set.toml":
            files[name] = _other_value(data.decode(), generator)
        case 2 | 3 if name == "samples.jsonl":
            files[name] = hostile_json(data.decode(), generator)
        case _:  # of large files, mostly the start: what follows are pixels
            head = 200 if generator.integers(4) else len(data)
            files[name] = spoiled(data[:head], generator) + data[head:]
    return files


_TOML: Final = ("true", "-1", "0", "1e308", "nan", "inf", '""', '"x"', "[]", "[1, 2]", "{}", "1979-05-27", "9" * 400)
_TOML_KEYS: Final = (*("a" + dot * 20_000 for dot in (".a", " . a", '."a"')), "[" * 5000, "a = {" * 5000)
_TOML_LONG: Final = ("0x" + "f" * 5000, "9" * 5000, "[" * 300 + "]" * 300, "[" * 5000, f'"{"y" * 9000}"', '"\\u0000"')


def _other_value(text: str, generator: Generator) -> bytes:
    """TOML with another value for one of its keys."""
    lines = text.splitlines()
    keyed = [number for number, line in enumerate(lines) if "=" in line and not line.startswith("#")]
    number = one_of(keyed, generator)
    values = _TOML if generator.integers(2) else _TOML_LONG
    key = lines[number].partition("=")[0]
    if generator.integers(8) == 0:
        key = one_of(_TOML_KEYS, generator)
    lines[number] = f"{key}= {one_of(values, generator)}"
    return "\n".join(lines).encode()


def hostile_rig(generator: Generator) -> bytes:
    """A rig file: spoiled as text, or with another value for one of its keys."""
    text = _rig_text()
    return spoiled(text.encode(), generator) if generator.integers(2) else _other_value(text, generator)


def hostile_landmarks(generator: Generator) -> bytes:
    """A landmark file by vertex or by coordinate: other values, other text."""
    tree: dict[str, Any] = {"format": "bodyseg landmarks 1"}
    if generator.integers(2):
        tree |= {"topology": "t", "vertex_count": 99, "face_count": 9}
        tree["landmarks"] = {name: number for number, name in enumerate(LANDMARKS)}
    else:
        tree |= {"units": "mm", "points": {name: [1.0 * number, 2.0, 3.0] for number, name in enumerate(LANDMARKS)}}
    if generator.integers(2):
        return hostile_json(json.dumps(tree), generator)
    return json.dumps(hostile_tree(tree, generator)).encode()


def hostile_lnd(generator: Generator) -> bytes:
    """A .lnd file of the survey."""
    rows = "".join(f"{n} 0 0 1 {n}.5 -{n}.25 1544.0  {name}\n" for n, name in enumerate(LANDMARKS))
    text = f"x\nAUX =\n{rows}END =\n".encode()
    return spoiled(text, generator) if generator.integers(8) else text


_PLY: Final = (
    "ply\nformat {form} 1.0\nelement vertex {vertices}\nproperty float x\nproperty float y\nproperty float z\n"
    "element face {faces}\nproperty list uchar int vertex_indices\nend_header\n"
)
_COUNTS: Final = (0, 1, 3, 1 << 31, 1 << 40, 10**15 - 1, 10**30)


def hostile_ply(generator: Generator) -> bytes:
    """A PLY file, in text or binary, with other counts or spoiled."""
    form = one_of(("ascii", "binary_little_endian", "binary_big_endian"), generator)
    counts = {"vertices": 3, "faces": 1}
    if generator.integers(2):
        counts[str(generator.choice(("vertices", "faces")))] = one_of(_COUNTS, generator)
    head = _PLY.format(form=form, **counts).encode()
    if form == "ascii":
        rows = b"0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
        return head + (spoiled(rows, generator) if generator.integers(8) else rows)
    order = form.partition("_")[2][0]
    corners = np.array([0, 1, 2], "<i4" if order == "l" else ">i4").tobytes()
    points = np.eye(3, dtype="<f4" if order == "l" else ">f4").tobytes()
    whole = head + points + b"\3" + corners
    return spoiled(whole, generator) if generator.integers(8) else whole


_SCENES: Final = {
    "room/scene.json": {
        "format": "bodyseg scene 1",
        "meshes": [
            {"mesh": "../box.ply", "labels": "../vertex_labels.json", "position_m": [0.5, 0, 0]},
            {"mesh": "../box.ply", "class": "wall", "units": "cm"},
        ],
        "centre_m": [0, 1, 0],
        "split": "test",
    },
    "vertex_labels.json": [0, 1, 1, 2],
    "classes.json": {"name": "rooms", "classes": ["wall", {"name": "floor", "colour": "#1e90ff"}, "man"]},
}
"""A folder of meshes with labels: name of a file of JSON -> content."""


def hostile_scenes(generator: Generator) -> dict[str, bytes]:
    """A folder of a scene and its classes, one of whose files is spoiled, has other values, or is missing."""
    points = np.eye(4, 3, dtype="<f4").tobytes()
    faces = b"".join(b"\3" + np.array(face, "<i4").tobytes() for face in ((0, 1, 2), (0, 3, 1), (1, 3, 2), (2, 3, 0)))
    files = {"box.ply": _PLY.format(form="binary_little_endian", vertices=4, faces=4).encode() + points + faces}
    files |= {name: json.dumps(tree).encode() for name, tree in _SCENES.items()}
    name = one_of([*_SCENES], generator)
    match int(generator.integers(6)):
        case 0:
            files["box.ply"] = hostile_ply(generator)
        case 1:
            files[name] = hostile_json(files[name].decode(), generator)
        case 2:
            del files[name]
        case 3 | 4:
            files[name] = json.dumps(hostile_tree(_SCENES[name], generator)).encode()
    return files


@lru_cache(maxsize=1)
def _recordings() -> dict[str, bytes]:
    """Name -> bytes of a recording of three frames."""
    frames = (1000 + np.arange(3 * 24 * 32).reshape(3, 24, 32) % 1717).astype(np.uint16)
    pages, found = [Image.fromarray(frame) for frame in frames], dict[str, bytes]()
    whole: dict[str, Any] = {"format": "TIFF", "save_all": True, "append_images": pages[1:]}
    writers: dict[str, Callable[[io.BytesIO], object]] = {
        "a.npy": lambda file: np.save(file, frames),
        "stack.npz": lambda file: np.savez(file, depth=frames, times=np.arange(3.0)),
        "packed.npz": lambda file: np.savez_compressed(file, f1=frames[0], f2=frames[1], f3=frames[2]),
        "a.tif": lambda file: pages[0].save(file, **whole),
        "big.tif": lambda file: pages[0].save(file, **whole, big_tiff=True),
        "lzw.tif": lambda file: pages[0].save(file, **whole, compression="tiff_lzw"),
    }
    for name, write in writers.items():
        buffer = io.BytesIO()
        write(buffer)
        found[name] = buffer.getvalue()
    return found


_DECLARED: Final = (b"(3, 24, 32)", (b"(999999999,)", b"(3, 24, -2)", b"(9, 99, 99)", b"(24, 32, 3)", b"(99999, 5)"))


def hostile_recording(generator: Generator) -> tuple[str, bytes]:
    """A recording: its name, and its bytes, spoiled mostly at its ends, where zips and TIFFs list what they hold, or
    with another shape in its header.
    """
    name = one_of([*_recordings()], generator)
    data = _recordings()[name]
    match int(generator.integers(5)):
        case 0:
            return name, data
        case 1:
            old, others = _DECLARED
            return name, data.replace(old, one_of(others, generator))
        case 2:
            return name, spoiled(data, generator)
        case 3:
            return name, spoiled(data[:300], generator) + data[300:]
        case _:
            return name, data[:-300] + spoiled(data[-300:], generator)


MAKERS: Final[dict[str, Callable[[Generator], Any]]] = {
    "bsi": hostile_bsi,
    "png": hostile_pngs,
    "sample": hostile_sample,
    "tar": hostile_tar,
    "manifest": hostile_manifest,
    "index": hostile_piece,
    "column": hostile_column,
    "renders": hostile_renders,
    "rig": hostile_rig,
    "landmarks": hostile_landmarks,
    "lnd": hostile_lnd,
    "ply": hostile_ply,
    "scenes": hostile_scenes,
    "recording": hostile_recording,
}
"""Target -> what makes an input for it."""
