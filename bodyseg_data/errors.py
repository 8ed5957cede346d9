"""The one family of errors that users meet.

Every message is one line and says which rule was broken, what was found, and where. Commands print that line
and exit with status 2; code that uses the library can catch `BodysegError` or a member of the family.
"""

from __future__ import annotations


class BodysegError(Exception):
    """Base of everything this project raises on purpose."""


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


class MissingLibrary(BodysegError):
    """An optional package or a system library that the chosen feature needs is not installed."""
