"""Files of strangers: bounded before they are believed, and refused in one line."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest

from bodyseg_data.core import BadConfig
from bodyseg_data.files import TomlFiles, parse_json, read_bytes, read_json

FILES = TomlFiles("thing", Path(), "thing 1")


@pytest.mark.parametrize(
    "text",
    [
        "a" + ".a" * 50_000 + " = 1",
        "[a" + ".a" * 50_000 + "]",
        "x = {a" + " . a" * 50_000 + " = 1}",
        "'a'" + ".'a'" * 50_000 + " = 1",
        'b = "."\n"a\\".a"' + ' . "a\\"."' * 50_000 + " = 1",
        "x = " + "[" * 100_000,
        "x = " + "{a = " * 100_000,
        "x = 0x" + "f" * 10_000,
        "#" + "a" * (1 << 20),
    ],
    ids=lambda text: text[:12],
)
def test_toml_is_bounded_before_it_is_parsed(text: str, tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_text(text)
    with pytest.raises(BadConfig, match=r"a\.toml is not TOML") as caught:
        FILES.parse(FILES.read(path), str(path))
    assert len(str(caught.value)) < 300 and "\n" not in str(caught.value)


def test_dots_that_are_no_key_are_read(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_text(f"format = 'thing 1'\nx = '{'a b. ' * 40}'\n# {'. ' * 40}\ny = [{'1.5, ' * 40}]\na.b.c = 1.5")
    assert FILES.parse(FILES.read(path), "")["a"] == {"b": {"c": 1.5}}


def test_json_nested_beyond_reason_is_one_line() -> None:
    for text in (b"[" * 100_000, b'{"a":' * 100_000):
        with pytest.raises(BadConfig, match="here is not JSON: (maximum recursion depth|Stack overflow)"):
            parse_json(text, "here")


@pytest.mark.parametrize("kind", ["pipe", "socket", "device"])
def test_what_is_no_plain_file_is_refused(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    with socket.socket(socket.AF_UNIX) as held:
        if kind == "pipe":
            os.mkfifo(path)
        elif kind == "socket":
            held.bind(str(path))
        else:
            path.symlink_to("/dev/zero")
        for read in (read_bytes, read_json, FILES.read):
            with pytest.raises(BadConfig, match="not a regular file"):
                read(path)
