"""`bodyseg <command>`, and `tools/<command>` in a checkout: one implementation."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence
from typing import Any, Final, Protocol

from bodyseg_data.errors import BadConfig, BodysegError
from bodyseg_data.options import parse

COMMANDS: Final[dict[str, tuple[str, str]]] = {
    "shard": ("bodyseg_data.commands.shard", "render bodies and pack them into shards"),
    "verify": ("bodyseg_data.commands.verify", "check every byte of a set of shards"),
    "inspect": ("bodyseg_data.commands.inspect", "draw a contact sheet of a set, or count what it holds"),
    "landmarks": ("bodyseg_data.commands.landmarks", "draw the 33 parts of a source's body from four sides"),
    "bench": ("bodyseg_data.commands.bench", "measure speed and accuracy side by side"),
    "demo": ("bodyseg_data.commands.demo", "pack a small open set and stream all five variants"),
}
"""Name -> (module, one line). Modules are imported when their command runs, so that no command pays for another."""

INTERNAL_ERROR: Final = 70  # EX_SOFTWARE of sysexits.h


class Command(Protocol):
    """What a command's module defines. `run` returns the exit status and raises BodysegError for bad input."""

    EXAMPLE: str
    Options: type[Any]

    def run(self, options: Any) -> int: ...


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; 0 done, 1 faults found, 2 bad argument or input, 130 interrupted, each said in one line."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help"):
        sys.stdout.write(_overview())
        return 0
    name = words[0]
    try:
        return _run(name, words[1:])
    except BodysegError as error:
        _say(name, str(error))
        return 2
    except KeyboardInterrupt:
        _say(name, "interrupted")
        return 130
    except BrokenPipeError:
        # Whoever read our output went away; nothing more can be said to them.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception as error:
        if os.environ.get("BODYSEG_TRACEBACK"):
            raise
        _say(name, f"internal error: {type(error).__name__}: {error} (BODYSEG_TRACEBACK=1 shows where)")
        return INTERNAL_ERROR


def _run(name: str, words: list[str]) -> int:
    if name not in COMMANDS:
        raise BadConfig(f"no such command; there are {', '.join(COMMANDS)}")
    module, summary = COMMANDS[name]
    command: Command = importlib.import_module(module)
    options = parse(command.Options, words, f"bodyseg {name}", summary, command.EXAMPLE)
    return command.run(options)


def _say(name: str, message: str) -> None:
    sys.stderr.write(f"bodyseg {name}: {' '.join(message.split())}\n")


def _overview() -> str:
    width = max(map(len, COMMANDS))
    lines = [f"  {name:{width}}  {summary}" for name, (_, summary) in COMMANDS.items()]
    return "\n".join(["usage: bodyseg COMMAND [--help] ...", "", *lines, ""])
