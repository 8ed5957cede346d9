"""The one family of errors that users meet.

Every message is one line and says which rule was broken, what was found, and where. Commands print that line
and exit with status 2; code that uses the library can catch `BodysegError` or a member of the family.
"""

from __future__ import annotations

from typing import Final

_LONGEST: Final = 1000


def one_line(text: str) -> str:
    """`text` with letters that cannot be printed escaped and, if it is very long, without its middle."""
    if len(text) > _LONGEST:
        text = f"{text[: _LONGEST // 2]} ... {text[-_LONGEST // 2 :]}"
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in text)


class BodysegError(Exception):
    """Base of everything this project raises on purpose.

    Its text is one line that can be printed, whatever was found in a file.
    """

    def __str__(self) -> str:
        return one_line(super().__str__())


class BadConfig(BodysegError):
    """An option, a rig file or a combination of arguments breaks a rule."""


class BadMesh(BodysegError):
    """A body cannot be used as a surface: empty, not finite, not human-sized, inside out."""


class Unanswerable(BadMesh):
    """A way to measure distances cannot answer on this surface; another one may."""


class BadLandmarks(BodysegError):
    """A landmark set does not name 33 usable places on the mesh it is meant for."""


class BadSample(BodysegError):
    """One sample's bytes or arrays are not what the format says."""


class BadShard(BodysegError):
    """A shard or its manifest is cut, altered, or of another format."""


class Unreachable(BodysegError):
    """Files of a remote set cannot be had: absent, refused, or too many attempts in a row have failed."""


class WorkerLost(BodysegError):
    """A worker process of a loader has ended, or failed, before its work was done."""


class Diverged(BodysegError):
    """A training's loss is no longer a number."""


class MissingLibrary(BodysegError):
    """An optional package or a system library that the chosen feature needs is not installed."""
