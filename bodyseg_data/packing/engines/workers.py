"""Jobs on a worker of a cluster, and the check before them that the worker would give the same bytes."""

from __future__ import annotations

import asyncio
import hashlib
import importlib.metadata
import platform
import socket
import threading
import uuid
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

from bodyseg_data.bodies.source import BodyRef
from bodyseg_data.core.errors import BadConfig, BodysegError
from bodyseg_data.core.sample import SHADOW_THRESHOLDS
from bodyseg_data.packing.options import PACKING_VERSION, Packing, evenly_sampled, forget_sources
from bodyseg_data.packing.skipping import SKIPPABLE

_SHAPE_BYTES: Final = (
    "bodyseg",
    "anny",
    "embreex",
    "llvmlite",
    "numba",
    "numpy",
    "pillow",
    "pygeodesic",
    "pymeshlab",
    "pyrender",
    "rtree",
    "scipy",
    "torch",
    "trimesh",
    "zstandard",
)
"""The packages that a sample's bytes can depend on."""

_SEEN_BODIES: Final = 8


@dataclass(frozen=True)
class Expected:
    """Facts that a worker must share with the process that packs, so that it gives the same bytes.

    installed: (name, version) pairs. seen: digest of the source's bodies as that process reads them. built: digest of
    the first of them as its processor computes it. token: tells this packing from an earlier one with the same options,
    whose files may have changed since.
    """

    packing: Packing
    installed: tuple[tuple[str, str], ...]
    seen: str
    built: str
    token: str


def expected(packing: Packing) -> Expected:
    """The facts of this process. Raises BodysegError as opening the source and building a body do."""
    with _one_at_a_time:
        forget_sources()
        return Expected(packing, installed(), _seen(packing), _built(packing), uuid.uuid4().hex)


@lru_cache(maxsize=1)
def installed() -> tuple[tuple[str, str], ...]:
    """(name, version or "none") of everything in this process that a sample's bytes can depend on."""
    found = [
        ("packing version", str(PACKING_VERSION)),
        ("shadow thresholds", str(SHADOW_THRESHOLDS)),
        ("processor", platform.machine()),
        ("python", ".".join(platform.python_version_tuple()[:2])),
    ]
    for name in _SHAPE_BYTES:
        try:
            version = importlib.metadata.version(name).partition("+")[0]  # which build of torch makes no difference
        except importlib.metadata.PackageNotFoundError:
            version = "none"
        found.append((name, version))
    return tuple(found)


def _seen(packing: Packing) -> str:
    """Digest of all bodies' names and of the files of a few: enough to tell another folder, and quickly read."""
    bodies = packing.bodies()
    few = evenly_sampled(bodies, min(_SEEN_BODIES, len(bodies)))
    return hashlib.sha256(repr((bodies, [_fingerprint(packing, body) for body in few])).encode()).hexdigest()


def _fingerprint(packing: Packing, body: BodyRef) -> str:
    try:
        return packing.opened().fingerprint([body])
    except SKIPPABLE:
        return "at fault"  # packing reports it, with all others


def _built(packing: Packing) -> str:
    """Digest of the first body that can be built, as built: libraries choose instructions by processor, and last bits
    differ with them.
    """
    for ref in packing.bodies():
        try:
            body = packing.opened().build(ref)
        except SKIPPABLE:
            continue
        arrays = (body.mesh.vertices, body.mesh.faces, body.landmarks)
        return hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()
    return "no body can be built"


# A body model, torch's number of threads and OpenGL are a process's, not a thread's.
_one_at_a_time = threading.RLock()


def fault(wanted: Expected) -> str | None:
    """The reason why this worker would not give the same bytes, or None."""
    with _one_at_a_time:
        return _fault(wanted)


@lru_cache(maxsize=64)
def _fault(wanted: Expected) -> str | None:
    for (name, there), (_, here) in zip(wanted.installed, installed(), strict=True):
        if there != here:
            return f"has {name} {here}, this machine has {there}: install the same versions on both"
    forget_sources()
    packing = wanted.packing
    try:
        if _seen(packing) != wanted.seen:
            if packing.path is None:
                return f"sees other bodies of the source {packing.source} than this machine: install the same on both"
            return f"sees other bodies in {packing.path} than this machine: share one folder with the workers"
        if _built(packing) != wanted.built:
            return (
                "builds the first body with other bits than this machine: use workers with the same kind of processor"
            )
    except BodysegError as error:
        return str(error)
    return None


async def check(wanted: Expected) -> str | None:
    """`fault` in a thread, so that the worker answers its scheduler meanwhile."""
    return await asyncio.to_thread(fault, wanted)


def job(wanted: Expected, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    """Call `function` on a worker; a BodysegError is returned, not raised, so that no log holds a traceback."""
    with _one_at_a_time:
        problem = fault(wanted)  # known already, unless this worker came late
        if problem is not None:
            return BadConfig(f"worker {socket.gethostname()} {problem}")
        try:
            return function(*arguments)
        except BodysegError as error:
            return error
