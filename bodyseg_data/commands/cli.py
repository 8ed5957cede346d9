"""Command line of several commands: imports and runs one, and reports every failure in one line.

`bodyseg_model.commands.cli` adds the commands on networks to those listed here.
"""

import contextlib
import importlib
import io
import os
import resource
import signal
import sys
import threading
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Protocol

from bodyseg_data.commands.options import parse, version_line
from bodyseg_data.core import BadConfig, BodysegError, reported
from bodyseg_data.machine import wait_briefly

Commands = Mapping[str, tuple[str, str]]

COMMANDS: Final[Commands] = {
    "shard": ("bodyseg_data.commands.shard", "render bodies and pack them into shards"),
    "join": ("bodyseg_data.commands.join", "join parts that were written side by side to one set"),
    "verify": ("bodyseg_data.commands.verify", "check every byte of a set of shards"),
    "inspect": ("bodyseg_data.commands.inspect", "draw a contact sheet of a set, or count what it holds"),
}
"""Name -> (place, summary). A place is a module, or "module:Class" where one has several commands. It is imported when
its command runs, so that no command loads another's imports.

Commands of a group have a name of two words, group and command, as "sensor fit".
"""

INTERNAL_ERROR: Final = 70  # EX_SOFTWARE of sysexits.h


class Command(Protocol):
    """Interface of a command's module or class. `run` returns the exit status and raises BodysegError for bad input."""

    EXAMPLE: str
    Options: type[Any]

    def run(self, options: Any) -> int: ...


_ENDINGS: Final[dict[int, str]] = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
_came: Final = list[int]()  # the signal that ends the command


def main(arguments: Sequence[str] | None = None, commands: Commands = COMMANDS, program: str = "bodyseg ") -> int:
    """Run one command; print a failure in one line on standard error.

    commands: those to choose from; program: the text before their names on a command line.

    Returns 0 done, 1 faults found, 2 bad argument or input, 130 interrupted, 141 output closed by its reader, 143
    terminated, 70 a bug in this program.
    """
    wait_briefly()
    words = list(sys.argv[1:] if arguments is None else arguments)
    name = " ".join(words[:2])  # of a command in a group, such as `sensor fit`
    name, words = (name, words[2:]) if name in commands else ("".join(words[:1]), words[1:])
    command = f"{program}{name}"
    for stream in ("stdout", "stderr"):
        if getattr(sys, stream) is None:  # closed by the parent process
            setattr(sys, stream, Path(os.devnull).open("w"))  # noqa: SIM115  open as long as the process
    if isinstance(sys.stdout, io.TextIOWrapper) and (sys.stdout.errors == "strict" or sys.stdout.encoding != "utf-8"):
        sys.stdout.reconfigure(errors="backslashreplace")  # a text may have letters that the terminal has not
    before, plain = _handle_signals(), warnings.formatwarning
    if not os.environ.get("BODYSEG_TRACEBACK"):  # without Python's file and line, which say nothing to a user
        warnings.formatwarning = lambda text, *of, **more: _line(command, f"warning: {text}")
    try:
        status = _run(program, commands, name, words)
        sys.stdout.flush()
        return status
    except BrokenPipeError:
        _leave_stdout()
        return 141
    except _interrupt():
        number = _came[0] if _came else signal.SIGINT
        return _say(command, _ENDINGS[number], 128 + number)
    except BodysegError as error:
        if os.environ.get("BODYSEG_TRACEBACK") and hasattr(error, "__notes__"):  # of a user's code, or in a worker
            raise
        return _say(command, str(error), 2)
    except OSError as error:
        if os.environ.get("BODYSEG_TRACEBACK"):
            raise
        try:
            sys.stdout.flush()
        except OSError:
            _leave_stdout()
        where = f"{error.filename}: " if error.filename else ""
        return _say(command, f"{where}{error.strerror or error}", 2)
    except Exception as error:
        if os.environ.get("BODYSEG_TRACEBACK"):
            raise
        if isinstance(error, UnicodeEncodeError) and error.encoding == "utf-8":  # of a library that opens files itself
            return _say(command, f"a path must be UTF-8 here, found {error.object!r:.200}", 2)
        what = BodysegError.words_of(error)
        if what == "RuntimeError: can't start new thread":
            return _say(command, "no thread can be started: ulimit -u or the container allows no more", 2)
        return _say(command, f"internal error: {what} (BODYSEG_TRACEBACK=1 shows where)", INTERNAL_ERROR)
    finally:
        warnings.formatwarning = plain
        _came.clear()
        for number, action in before.items():
            if signal.getsignal(number) is _stop:  # else a signal is ending this process
                signal.signal(number, action)


def _leave_stdout() -> None:
    """Send the buffered rest of standard output nowhere: flushing it at exit would raise again."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


_COMMAND: Final = os.getpid()


def _handle_signals() -> dict[signal.Signals, Any]:
    """Make SIGINT and SIGTERM end the command in order; returns the former handlers of the signals changed."""
    if threading.current_thread() is not threading.main_thread():
        return {}  # only the main thread may set handlers
    numbers = [number for number in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(number) != signal.SIG_IGN]
    return {number: signal.signal(number, _stop) for number in numbers}


def _stop(number: int, frame: Any) -> None:
    if os.getpid() != _COMMAND:  # a fork, such as a loader's worker, which prints nothing
        os._exit(128 + number)
    # A second Ctrl-C must not interrupt the cleaning up.
    for again in (signal.SIGINT, signal.SIGTERM):
        signal.signal(again, signal.SIG_IGN)
    _came.append(number)
    raise KeyboardInterrupt


def _interrupt() -> type[BaseException]:
    """What an interrupt may arrive as: where C has called Python, as LLVM does, it becomes another error."""
    return BaseException if _came else KeyboardInterrupt


def _run(program: str, commands: Commands, name: str, words: list[str]) -> int:
    group = {each: entry for each, entry in commands.items() if each.startswith(f"{name} ")}
    if group and words[:1] in ([], ["-h"], ["--help"]):
        sys.stdout.write(_overview(program, group, name))
        return 0
    if group:
        raise BadConfig(f"no such command; there are {', '.join(group)}")
    if name in ("", "-h", "--help"):
        sys.stdout.write(_overview(program, commands))
        return 0
    if name == "--version":
        sys.stdout.write(f"{version_line()}\n")
        return 0
    if name not in commands:
        raise BadConfig(f"no such command; there are {', '.join(commands)}")
    with reported("the current folder was deleted, and perhaps made again: cd to it or another", BadConfig, OSError):
        Path.cwd()  # without one, PyTorch ends the process
    allowed = resource.getrlimit(resource.RLIMIT_AS)[0]  # -1 or a large number: as much as there is
    if 0 <= allowed < 1 << 32:
        _say(f"{program}{name}", f"note: ulimit -v allows {allowed / 1e9:.1f} GB; beyond, libraries abort or hang", 0)
    place, summary = commands[name]
    command = load_command(place)
    options = parse(command.Options, words, f"{program}{name}", summary, command.EXAMPLE)
    return 0 if options is None else command.run(options)


def load_command(place: str) -> Command:
    """Import the command at a place of `COMMANDS`."""
    module, _, name = place.partition(":")
    found = importlib.import_module(module)
    return getattr(found, name) if name else found


def _say(command: str, message: str, status: int) -> int:
    with contextlib.suppress(OSError):  # standard error is closed
        sys.stderr.write(_line(command, message))
    return status


def _line(command: str, message: str) -> str:
    return f"{command.strip()}: {' '.join(message.split())}\n"


def _overview(program: str, commands: Commands, group: str = "") -> str:
    width = max(map(len, commands))
    lines = [f"  {name:{width}}  {summary}" for name, (_, summary) in commands.items()]
    version = f"\n       {program}--version" if program.endswith(" ") and not group else ""
    return "\n".join([f"Usage: {program}{group and f'{group} '}COMMAND [--help] ...{version}", "", *lines, ""])
