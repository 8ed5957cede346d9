"""Hostile input: readers give something or refuse in one line, in bounded time and memory; nothing reads pickle."""

from __future__ import annotations

import ast
import io
import json
import os
import re
import struct
import tarfile
import time
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warm
from benches.fuzzing import fuzzing
from benches.fuzzing.bench import _LOOPS, by_all_loops
from benches.fuzzing.fuzzing import TARGETS, Target, campaign, feed, one_input
from benches.fuzzing.hostile_files import KEY, hostile_tar
from folders import ROOT
from PIL import Image

from bodyseg_data.core import BadConfig, BadSample, BadShard, BodysegError
from bodyseg_data.rigs.rig import parse_sensor
from bodyseg_data.shards import BODY_FIELDS, MANIFEST_NAME, encode_sample, read_manifest, record_from_json
from bodyseg_data.shards.sample_codec import decode_sample
from bodyseg_data.shards.tar import parse_members
from bodyseg_model.commands import main

INPUTS = int(os.environ.get("BODYSEG_FUZZ", "40"))
"""How many inputs each reader gets here; `bench reliability` feeds 100 000."""


@pytest.mark.parametrize("target", TARGETS)
def test_hostile_input_is_read_or_refused(target: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if target not in _LOOPS:  # which nothing is compiled for
        monkeypatch.setattr(fuzzing, "WARMING", 8)
    figures = feed(target, 1, range(INPUTS if target != "lnd" else INPUTS // 3), tmp_path)
    assert figures["faults"] == []
    assert figures["read"] > 0, "some inputs are sound, or spoiled where it does not matter"
    assert figures["refused"] > figures["inputs"] // 3


@pytest.mark.parametrize(("target", "number"), [("manifest", 8502), ("column", 848), ("index", 2217), ("sample", 60)])
def test_what_once_was_a_fault_is_none(target: str, number: int, tmp_path: Path) -> None:
    """Lists in lists of numbers; brackets too deep to write again; and a sample that could not be made."""
    assert feed(target, 0, range(number, number + 1), tmp_path)["faults"] == []


def test_compiled_loops_and_plain_ones_read_the_same_in_a_process_of_limited_memory() -> None:
    assert by_all_loops("bsi", range(30))["faults"] == []


@pytest.mark.parametrize(
    ("read", "fault"),
    [
        (lambda data, folder: {}["x"], "KeyError: 'x'"),
        (lambda data, folder: len(bytearray(1 << 26)), "times the memory allowed"),
        (lambda data, folder: _spin(), "took "),
        (lambda data, folder: _refuse("x" * 900_000 + "\n"), ""),
    ],
)
def test_a_reader_that_misbehaves_would_be_seen(
    read: Any, fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fuzzing, "SECONDS_EACH", 0.02)
    monkeypatch.setattr(fuzzing, "_warm_up", lambda *_: None)
    monkeypatch.setitem(TARGETS, "tar", Target(read, (BadSample,)))
    faults = feed("tar", 0, range(2), tmp_path)["faults"]
    assert any(fault in line for line in faults) if fault else faults == []


def _spin() -> int:
    start = time.process_time()
    while time.process_time() < start + 0.06:
        pass
    return 1


def _refuse(text: str) -> None:
    raise BadSample(text)


def test_a_process_that_dies_is_a_fault() -> None:
    (fault,) = campaign("no such reader", 0, range(1))["faults"]
    assert fault.startswith("status 1: ")


def test_an_error_is_one_printable_line_whatever_was_found() -> None:
    shown = str(BodysegError("found \x1b[31m\ud800\n" + "y" * 100_000 + " at the end"))
    assert shown.isprintable()
    assert shown.startswith(r"found \x1b[31m\ud800\ny")
    assert shown.endswith(" at the end")
    assert len(shown) < 1200


def _png(*chunks: tuple[bytes, bytes]) -> bytes:
    parts = [struct.pack(">I", len(d)) + n + d + struct.pack(">I", zlib.crc32(n + d)) for n, d in chunks]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


_SIDES = struct.pack(">IIBBBBB", 4, 4, 8, 0, 0, 0, 0)
_PIXELS = (b"IDAT", zlib.compress(bytes(20)))
_BOMB = zlib.compress(bytes(1 << 24))


@pytest.mark.parametrize(
    "chunks",
    [
        [(b"IHDR", _SIDES), (b"IHDR", struct.pack(">IIBBBBB", 40_000, 40_000, 8, 0, 0, 0, 0)), _PIXELS, (b"IEND", b"")],
        [(b"IHDR", _SIDES), (b"acTL", struct.pack(">II", 7, 0)), _PIXELS, (b"IEND", b"")],
        [(b"IHDR", _SIDES), *[(b"zTXt", b"k\0\0" + _BOMB)] * 3, _PIXELS, (b"IEND", b"")],
        [(b"IHDR", _SIDES), (b"iCCP", b"k\0\0" + _BOMB), _PIXELS, (b"IEND", b"")],
        [(b"IHDR", _SIDES), _PIXELS],
        [_PIXELS, (b"IHDR", _SIDES), (b"IEND", b"")],
    ],
)
def test_a_png_with_more_than_its_pixels_is_refused(chunks: list[tuple[bytes, bytes]]) -> None:
    members = _sample_of_pngs()
    assert decode_sample(KEY, members).labels.shape == (2, 2)
    with pytest.raises(BadSample, match=r"labels\.png: not a readable PNG: "):
        decode_sample(KEY, members | {"labels.png": _png(*chunks)})


def _sample_of_pngs() -> dict[str, bytes]:
    from samples import GOOD

    return encode_sample(GOOD, "png")


@pytest.mark.parametrize(
    "picture",
    [Image.new(mode, (2, 2)) for mode in ("1", "LA", "P", "RGB", "RGBA")],
    ids=lambda picture: picture.mode,
)
def test_a_png_of_other_pixels_is_refused(picture: Image.Image) -> None:
    buffer = io.BytesIO()
    picture.save(buffer, "PNG")
    with pytest.raises(BadSample, match=r"labels\.png: "):
        decode_sample(KEY, _sample_of_pngs() | {"labels.png": buffer.getvalue()})


def _member(kind: bytes, name: str = f"{KEY}.json", link: str = "", data: bytes = b"{}") -> bytes:
    header = tarfile.TarInfo(name)
    header.type, header.linkname, header.size = kind, link, len(data)
    return header.tobuf(tarfile.GNU_FORMAT) + data + bytes(-len(data) % 512)


@pytest.mark.parametrize(
    "data",
    [
        *(_member(kind, link="/etc/passwd") for kind in (tarfile.SYMTYPE, tarfile.LNKTYPE)),
        *(_member(kind) for kind in (tarfile.CHRTYPE, tarfile.BLKTYPE, tarfile.DIRTYPE, tarfile.FIFOTYPE)),
        *(_member(kind) for kind in (tarfile.CONTTYPE, tarfile.GNUTYPE_SPARSE, tarfile.AREGTYPE, b"V", b"M")),
        *(_member(kind, data=b"30 path=../../../etc/passwd\n") for kind in (tarfile.XHDTYPE, tarfile.XGLTYPE)),
        *(_member(kind, data=b"../x\0") for kind in (tarfile.GNUTYPE_LONGNAME, tarfile.GNUTYPE_LONGLINK)),
        *(
            _member(tarfile.REGTYPE, name)
            for name in (f"../{KEY}.json", f"/{KEY}.json", f"x/{KEY}.json", f"{KEY}/.json")
        ),
        *(_member(tarfile.REGTYPE, name) for name in ("C:\\x.json", f"{KEY}x.json", KEY, f"{KEY}.", ".json")),
    ],
)
def test_links_devices_and_paths_in_tars_are_refused(data: bytes) -> None:
    assert parse_members(KEY, _member(tarfile.REGTYPE)) == {"json": b"{}"}
    with pytest.raises(BadSample, match=f"^{KEY}: "):
        parse_members(KEY, data)


def test_nothing_in_a_tar_is_ever_a_path_to_write_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for number in range(200):
        try:
            parse_members(KEY, hostile_tar(np.random.default_rng(number)))
        except BadSample:
            continue
    assert list(tmp_path.iterdir()) == []


def test_brackets_nested_as_deeply_as_can_just_be_read_are_refused(tmp_path: Path) -> None:
    for depth in range(960, 1004):
        nested = "[" * depth + "]" * depth
        (tmp_path / MANIFEST_NAME).write_text(f'{{"digest":"x","format":"bodyseg shards 7","shards":{nested}}}')
        with pytest.raises(BadShard):
            read_manifest(tmp_path)


@pytest.mark.parametrize(
    "value", ["0x" + "f" * 5000, "9" * 5000, "[" * 5000, '"\\u0000"', "'y'", "{a = 0x" + "f" * 5000 + "}"]
)
@pytest.mark.parametrize("key", ["name", "stand_off_m", "camera", "format"])
def test_a_rig_with_a_value_beyond_reason_is_refused_in_one_line(key: str, value: str) -> None:
    with pytest.raises(BadConfig, match="^rig x"):
        parse_sensor(
            f'format = "bodyseg rig 1"\n{key} = {value}\n'.replace('format = "bodyseg rig 1"\nformat', "format"), "x"
        )


@pytest.mark.parametrize("digest", ["x\ny", "\ud800", ["y" * 100_000], {"a": [None]}, 3])
def test_verify_says_one_line_of_a_manifest_that_holds_anything(
    digest: object, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / MANIFEST_NAME).write_text(json.dumps({"format": "bodyseg shards 7", "digest": digest}))
    assert main(["verify", str(tmp_path)]) == 1
    said = capsys.readouterr().out
    assert said.count("\n") == 1
    assert len(said) < 2000


@pytest.mark.parametrize("note", ["a: x\nb: y", "a: \x1b[31m", "a: \ud800"])
def test_a_note_that_cannot_be_printed_is_refused(note: str, figures_set: Path) -> None:
    record = json.loads((figures_set / MANIFEST_NAME).read_bytes())["shards"][0]
    assert record_from_json({**record, "notes": ["a: x"]}, BODY_FIELDS, "here").notes == ("a: x",)
    with pytest.raises(BadShard, match="'notes' must be a list of text that can be printed"):
        record_from_json({**record, "notes": [note]}, BODY_FIELDS, "here")


def test_verify_ends_tidily_whatever_a_manifest_holds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for number in range(60):
        (tmp_path / MANIFEST_NAME).write_bytes(one_input("manifest", 2, number))
        status = main(["verify", str(tmp_path)])
        printed = capsys.readouterr()
        assert status in (0, 1)  # 0: a manifest without shards
        assert all(line.isprintable() for line in printed.out.splitlines())
        assert all(line.startswith("verifying: ") for line in printed.err.splitlines())


_PICKLES = {"pickle", "_pickle", "cPickle", "cloudpickle", "dill", "joblib", "shelve", "marshal", "pandas"}
_SUSPECT = re.compile(r"pickle|dill|joblib|shelve|marshal|pandas|\.load\b|\b(eval|exec)\b")
"""What a program that reads pickle holds, so that few need to be parsed."""

_LOADERS = {"torch.load", "torch.jit.load", "jit.load", "np.load", "numpy.load", "yaml.load"}


def pickles_in(text: str) -> list[str]:
    """What in a program reads pickle, or may."""
    if not _SUSPECT.search(text):
        return []
    found, plain = [], set[int]()  # plain: of calls that refuse it
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names if alias.name.partition(".")[0] in _PICKLES]
        elif isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] in _PICKLES:
            found.append(node.module or "")
        elif isinstance(node, ast.Call) and node.keywords and ast.unparse(node.keywords[-1]) == "allow_pickle=False":
            plain |= {id(node.func), *map(id, node.keywords)}
        elif id(node) in plain:
            continue
        elif isinstance(node, ast.Attribute) and node.attr == "load" and ast.unparse(node) in _LOADERS:
            found.append(ast.unparse(node))
        elif isinstance(node, ast.keyword) and node.arg == "allow_pickle":
            found.append("allow_pickle")
        elif isinstance(node, ast.Name) and node.id in ("eval", "exec"):
            found.append(node.id)
    return found


def test_no_file_of_the_package_reads_pickle() -> None:
    assert pickles_in("import pickle\nnp.load('x', allow_pickle=True)\ntorch.load('y')") == [
        "pickle",
        "np.load",
        "allow_pickle",
        "torch.load",
    ]
    assert pickles_in("np.load('x', allow_pickle=False)") == []
    files = [path for room in ("bodyseg_data", "bodyseg_model") for path in (ROOT / room).rglob("*.py")]
    assert len(files) > 60
    # A door runs its own code once more, that of the very file which is being imported, to see what it names.
    # A worker process unpickles what this process hands to it.
    # numba keeps machine code in pickles, in a folder that only this user may write, and types of arguments go to the
    # process that compiles for them.
    allowed = {"doors.py": ["exec"], "workers.py": ["pickle"], "kernels.py": ["pickle"]}
    assert {path.name: found for path in files if (found := pickles_in(path.read_text()))} == allowed


_READ_EVERYTHING = """
import sys

def refuse(event, arguments):
    if event == "pickle.find_class":
        caller = sys._getframe(1).f_globals.get("__name__")
        if caller != "numba.core.caching":
            raise RuntimeError(f"{caller} reads pickle: {arguments}")

sys.addaudithook(refuse)
from bodyseg_data import RangeImages, loader
from bodyseg_data.commands.cli import main

for variant in ("none", "occ", "noise", "md", "all"):
    for batch in loader(RangeImages(sys.argv[1], variant), 8):
        pass
assert len(list(RangeImages(sys.argv[1]).webdataset())) == 24
assert main(["verify", sys.argv[1]]) == 0
assert main(["inspect", sys.argv[1], "--json"]) == 0
assert ("numba" in sys.modules) == (sys.argv[2] == "compiled")
import collections, pickle
try:
    pickle.loads(pickle.dumps(collections.OrderedDict()))
except RuntimeError:
    sys.exit(0)
sys.exit("the hook does not work")
"""


def test_streaming_in_one_process_reads_no_pickle(small_set: Path) -> None:
    """Besides what numba keeps of its compiled loops, which is code, like Python's own."""
    environment = {**os.environ, "BODYSEG_KERNELS": "compiled"}
    done = warm.run(["-c", _READ_EVERYTHING, str(small_set), "compiled"], env=environment)
    assert done.returncode == 0, done.stderr
