"""Errors that users meet, all derived from `BodysegError`, and the check of whole-number arguments.

Every message is one line: the rule that was broken, the value found, and where. Commands print that line and exit with
status 2; code that uses the library can catch `BodysegError` or one of its subclasses.
"""

from __future__ import annotations

from numbers import Integral
from typing import Any, Final, TypeVar

_LONGEST: Final = 1000


def one_line(text: str) -> str:
    """Return `text` with unprintable characters escaped and, beyond 1000 characters, without its middle."""
    if len(text) > _LONGEST:
        text = f"{text[: _LONGEST // 2]} ... {text[-_LONGEST // 2 :]}"
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in text)


class BodysegError(Exception):
    """Base of every error that this project raises on purpose; its text is always one printable line."""

    def __str__(self) -> str:
        return one_line(super().__str__())


class BadConfig(BodysegError):
    """An option, a rig file or a combination of arguments breaks a rule."""


class BadMesh(BodysegError):
    """A body cannot be used as a surface: empty, not finite, not human-sized, inside out."""


class Unanswerable(BadMesh):
    """One method of measuring distances fails on this surface; another may work."""


class BadLandmarks(BodysegError):
    """A landmark set does not give 33 usable points on its mesh."""


class BadSample(BodysegError):
    """One sample's bytes or arrays break the format."""


class BadShard(BodysegError):
    """A shard or its manifest is cut, altered, or of another format."""


class BadTransform(BodysegError):
    """A transform has failed on a sample, or returned something that is no sample."""


class Unreachable(BodysegError):
    """Files of a remote set cannot be fetched: absent, refused, or too many attempts in a row have failed."""


class WorkerLost(BodysegError):
    """A worker process of a loader has ended, or failed, before its work was done."""


class Diverged(BodysegError):
    """A training's loss is no longer a number."""


class MissingLibrary(BodysegError):
    """An optional package or a system library that the chosen feature needs is not installed."""


_Error = TypeVar("_Error", bound=Exception)


def with_text(error: _Error, text: str) -> _Error:
    """Return a new error of the same class and notes with another text, tied to no traceback's frames."""
    found = type(error)(text)
    for note in getattr(error, "__notes__", ()):
        found.add_note(note)
    return found


def check_int(name: str, value: Any, least: int) -> int:
    """Return `value` as an int. Raises BadConfig, calling it `name`, unless it is a whole number of at least `least`.

    A bool is refused; NumPy's integers are accepted.
    """
    if isinstance(value, bool) or not isinstance(value, Integral) or int(value) < least:
        raise BadConfig(f"{name} must be a whole number of at least {least}, found {value!r}")
    return int(value)
