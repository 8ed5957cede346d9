"""Command lines made of options: what stands beside results."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import pytest

from bodyseg_data.commands import command_line, option
from bodyseg_data.commands.options import parse
from bodyseg_data.core import BadConfig


@dataclass(frozen=True)
class Options:
    frames: tuple[Path, ...] = option("files", positional=True)
    data: str = option("a set", address=True)
    out: Path | None = option("a file", None)
    sizes: tuple[int, ...] = option("numbers", ())
    rate: float = option("a number", 0.5)
    quiet: bool = option("a switch", False)


def test_only_what_differs_from_defaults_is_said_and_no_folder_of_this_machine() -> None:
    words = ["/home/me/a.png", "b.png", "--data", "https://host/set", "--out", "/home/me/x.json", "--sizes", "3", "4"]
    options = parse(Options, [*words, "--quiet"], "program", "", "")
    assert command_line("program", options) == (
        "program a.png b.png --data https://host/set --out x.json --sizes 3 4 --quiet"
    )
    local = parse(Options, ["a.png", "--data", "/home/me/shards"], "program", "", "")
    assert command_line("program", local) == "program a.png --data shards"


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("https://me:secret@host/set/train-*.tar?token=secret", "https://host/set/train-*.tar"),
        ("s3://bucket/set/train-0000?.tar", "s3://bucket/set/train-0000?.tar"),
        ("hf://datasets/OWNER/NAME@v1.0", "hf://datasets/OWNER/NAME@v1.0"),
    ],
)
def test_no_secret_of_an_address_is_said(given: str, said: str) -> None:
    assert command_line("program", Options((Path("a.png"),), given)) == f"program a.png --data {said}"


@dataclass(frozen=True)
class Ranges:
    pitch: tuple[str, ...] = option("numbers or a range", ("0",))
    roll: tuple[str, ...] = option("numbers or a range", ("0",))


@pytest.mark.parametrize(
    ("line", "pitch", "roll"),
    [
        ("--pitch -30..10 --roll -5..-1", ("-30..10",), ("-5..-1",)),
        ("--pitch=-30..10 --roll 5", ("-30..10",), ("5",)),
        ("--roll 0 -15 -30 --pitch 3..5", ("3..5",), ("0", "-15", "-30")),
    ],
)
def test_a_range_may_begin_with_a_negative_number(line: str, pitch: tuple[str, ...], roll: tuple[str, ...]) -> None:
    options = parse(Ranges, line.split(), "program", "", "")
    assert options == Ranges(pitch, roll)
    assert parse(Ranges, command_line("program", options).split()[1:], "program", "", "") == options


def test_a_range_without_its_flag_is_no_flag_either() -> None:
    with pytest.raises(BadConfig):
        parse(Ranges, ["-30..10"], "program", "", "")


def test_help_stands_under_headings(capsys: pytest.CaptureFixture[str]) -> None:
    @dataclass(frozen=True)
    class Divided:
        out: str = option("a file")
        near: float = option("a limit", 1.0, heading="Limits")
        far: float = option("another", 2.0)
        quiet: bool = option("a switch", False, heading="A report")

    assert parse(Divided, ["--help"], "program", "", "") is None
    words = re.findall(r"Parameters|Limits|A report|--\w+", capsys.readouterr().out.partition("\n")[2])
    assert words == ["Parameters", "--out", "Limits", "--near", "--far", "A report", "--quiet"]


@pytest.mark.timeout(20)
@pytest.mark.parametrize("columns", ["0", "2"])
def test_help_comes_whatever_width_the_terminal_claims(
    columns: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    assert parse(Ranges, ["--help"], "program", "what it does", "an example") is None
    assert "numbers or a range" in capsys.readouterr().out
