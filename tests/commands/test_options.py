"""Command lines made of options: what stands beside results."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from bodyseg_data.commands.options import command_line, option, parse


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
