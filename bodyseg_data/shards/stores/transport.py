"""One attempt to get bytes from behind an address, through fsspec: HTTP as a stream, anything else block by block.

No event loop, session or socket crosses a fork: every process opens its own filesystem when it first needs one.
"""

from __future__ import annotations

import errno
import inspect
import os
import re
import time
import uuid
import weakref
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from typing import Any, Final, Protocol

from bodyseg_data.core.errors import MissingLibrary

_PIECE_BYTES: Final = 1 << 20
_PIECE_S: Final = 0.2
_BLOCK_BYTES: Final = 4 << 20
"""Of filesystems that give a range whole or not at all: what a broken connection can lose."""

_PASSING: Final = frozenset({408, 425, 429, 500, 502, 503, 504})
_FINAL: Final = (PermissionError, IsADirectoryError, ValueError, TypeError, NotImplementedError)
_FINAL_NAMES: Final = frozenset(
    {"NoCredentialsError", "PartialCredentialsError", "ProfileNotFound", "ParamValidationError"}
)
_FINAL_NUMBERS: Final = frozenset({errno.EINVAL, errno.ENOSYS})
_LISTINGS: Final = frozenset({"use_listings_cache", "listings_expiry_time", "max_paths"})
_CONTENT_RANGE: Final = re.compile(r"bytes ([0-9]{1,19})-([0-9]{1,19})/([0-9]{1,19}|\*)")


class Failed(Exception):
    """Another attempt may do better; `wait_s` is how long the server asks to be left alone."""

    def __init__(self, problem: str, wait_s: float = 0.0) -> None:
        super().__init__(problem)
        self.wait_s = wait_s


class Refused(Exception):
    """Every other attempt would end as this one."""


class NotThere(Refused):
    """There is no such file."""


class Transport(Protocol):
    """All methods take full addresses and raise Failed, Refused or NotThere."""

    def pieces(self, address: str, start: int, stop: int, skips: bool) -> Iterator[bytes]:
        """Bytes `start` to `stop` in order; whatever came before an error is right.

        skips: where a server gives whole files only, skip what comes before `start` instead of refusing.
        """

    def whole(self, address: str, limit: int) -> bytes:
        """All bytes of a file that has at most `limit`."""

    def size(self, address: str) -> int:
        """Bytes of a file."""


_FILESYSTEMS: dict[tuple[int, str], Any] = {}
"""By process, so that a fork leaves its parent's alone; it is kept, since closing it would disturb the parent."""


class _Filesystem:
    """An fsspec filesystem that every process opens for itself; what is pickled are its options."""

    def __init__(self, protocol: str, options: Mapping[str, Any]) -> None:
        self._protocol, self._options = protocol, dict(options)
        self._token = uuid.uuid4().hex
        weakref.finalize(self, _forget, self._token)

    def get(self) -> Any:
        place = (os.getpid(), self._token)
        if place not in _FILESYSTEMS:
            _FILESYSTEMS.setdefault(place, self._open())
        return _FILESYSTEMS[place]

    def _open(self) -> Any:
        try:
            made = import_module("fsspec").filesystem(self._protocol, skip_instance_cache=True, **self._options)
        except ImportError as error:
            raise MissingLibrary(
                f"{self._protocol}:// addresses need packages: pip install 'bodyseg[remote]' has those of http and s3 "
                f"({error})"
            ) from None
        if hasattr(made, "retries"):
            made.retries = 1  # s3fs: who asks counts the attempts
        return made


def _forget(token: str) -> None:
    _FILESYSTEMS.pop((os.getpid(), token), None)


def open_transport(protocol: str, options: Mapping[str, Any], stall_s: float, total_s: float) -> Transport:
    """The way to files of `protocol`. Raises MissingLibrary, or anything that the filesystem has against `options`."""
    if protocol in ("http", "https"):
        return _Http(_Filesystem(protocol, options), stall_s)
    if protocol in ("s3", "s3a"):
        waits = {"connect_timeout": stall_s, "read_timeout": stall_s, "retries": {"total_max_attempts": 1}}
        options = {**options, "config_kwargs": {**waits, **options.get("config_kwargs", {})}}
    return _Blocks(_Filesystem(protocol, options), total_s)


class _Http:
    """Streams through aiohttp, in fsspec's session and thread, so that what came before a connection broke is kept.

    fsspec's own `cat_file` and `open` lose that, and do not check which range came (docs/dependencies.md has figures).
    """

    def __init__(self, filesystem: _Filesystem, stall_s: float) -> None:
        self._opened, self._stall_s = filesystem, stall_s
        filesystem.get()

    def pieces(self, address: str, start: int, stop: int, skips: bool) -> Iterator[bytes]:
        with _translated(), self._response(address, start, stop) as (response, piece, problem):
            position = start
            if response.status != 206:
                if not skips:
                    raise Refused("the server ignores byte ranges; a cache with room for whole shards needs none")
                position = 0
            while True:
                wanted = piece[max(start - position, 0) : stop - position]
                position += len(piece)
                if wanted:
                    yield wanted
                if position >= stop:
                    return
                if problem is not None:
                    raise problem
                if not piece:
                    raise Failed(f"cut short: {stop} bytes expected, found {position}")
                piece, problem = self._run(_read, response)

    def whole(self, address: str, limit: int) -> bytes:
        data = bytearray()
        with _translated(), self._response(address, None, None) as (response, piece, problem):
            while piece or problem is not None:
                data += piece
                if len(data) > limit:
                    raise Refused(f"at most {limit} bytes are read, found more")
                if problem is not None:
                    raise problem
                piece, problem = self._run(_read, response)
        return bytes(data)

    def size(self, address: str) -> int:
        with _translated(), self._response(address, 0, 1) as (response, _, _):
            if response.status == 206:
                total = response.headers.get("Content-Range", "").rpartition("/")[2]
            else:
                total = response.headers.get("Content-Length", "")
            if not re.fullmatch(r"[0-9]{1,19}", total):
                raise Refused("the server does not say how large the file is")
            return int(total)

    @contextmanager
    def _response(self, address: str, start: int | None, stop: int | None) -> Iterator[tuple[Any, bytes, Any]]:
        """The server's answer, and what `_read` first gives of it."""
        response, piece, problem = self._run(self._ask, address, start, stop)
        try:
            _check_response(response, start, stop)
            yield response, piece, problem
        finally:
            self._run(_end, response)

    async def _ask(self, address: str, start: int | None, stop: int | None) -> tuple[Any, bytes, Any]:
        filesystem = self._opened.get()
        session = await filesystem.set_session()
        request = _request_options(filesystem)
        headers = {**(request.pop("headers", None) or {}), "Accept-Encoding": "identity"}
        if start is not None and stop is not None:
            headers["Range"] = f"bytes={start}-{stop - 1}"
        if "timeout" not in request:
            timeout = import_module("aiohttp").ClientTimeout
            request["timeout"] = timeout(total=None, sock_connect=self._stall_s, sock_read=self._stall_s)
        encoded = bool(filesystem.storage_options.get("encoded", False))
        url = import_module("yarl").URL(address, encoded=encoded)
        response = await session.get(url, headers=headers, **request)
        return response, *await _read(response)

    def _run(self, work: Any, *arguments: Any) -> Any:
        """The result of a coroutine, which runs in fsspec's thread."""
        return import_module("fsspec.asyn").sync(self._opened.get().loop, work, *arguments)


def _request_options(filesystem: Any) -> dict[str, Any]:
    """The options that aiohttp gets with every request: those that are neither the filesystem's nor of its listings."""
    own = inspect.signature(type(filesystem).__init__).parameters.keys() | _LISTINGS
    return {name: value for name, value in filesystem.storage_options.items() if name not in own}


async def _read(response: Any) -> tuple[bytes, Exception | None]:
    """Some bytes, and what went wrong after them; none of either is the end.

    Reads on for a while, from when the headers came: a stream that breaks forgets what it was not yet asked for.
    """
    data = bytearray()
    until = time.monotonic() + _PIECE_S
    try:
        while len(data) < _PIECE_BYTES and time.monotonic() < until:
            piece = await response.content.readany()
            if not piece:
                break
            data += piece
    except Exception as error:
        return bytes(data), error
    return bytes(data), None


async def _end(response: Any) -> None:
    """Give the connection back if all was read, else close it."""
    response.close()


def _check_response(response: Any, start: int | None, stop: int | None) -> None:
    status = response.status
    if status in (404, 410):
        raise NotThere(f"{status} {response.reason}")
    if status == 416:
        raise Failed(f"ends before byte {start}")
    if status in _PASSING:
        wait = response.headers.get("Retry-After", "")
        raise Failed(f"{status} {response.reason}", float(wait) if re.fullmatch(r"[0-9]{1,6}", wait) else 0.0)
    if status not in (200, 206) or (start is None and status == 206):
        raise Refused(f"{status} {response.reason}")
    if response.headers.get("Content-Encoding", "identity") != "identity":
        raise Refused(f"the server sends it packed ({response.headers['Content-Encoding']}), though asked not to")
    if status == 206:
        found = response.headers.get("Content-Range", "")
        match = _CONTENT_RANGE.fullmatch(found)
        if match is None or int(match[1]) != start:
            raise Failed(f"bytes {start} to {stop} asked for, found Content-Range {found!r}")


class _Blocks:
    """Any other filesystem that fsspec knows."""

    def __init__(self, filesystem: _Filesystem, total_s: float) -> None:
        self._opened = filesystem
        # Asynchronous ones give up by themselves; the limit is for those that would not.
        self._limit = {"timeout": total_s} if getattr(filesystem.get(), "async_impl", False) else {}

    def pieces(self, address: str, start: int, stop: int, skips: bool) -> Iterator[bytes]:
        with _translated():
            while start < stop:
                end = min(start + _BLOCK_BYTES, stop)
                data = self._opened.get().cat_file(address, start=start, end=end, **self._limit)
                if len(data) > end - start:
                    raise Failed(f"bytes {start} to {end} asked for, {len(data)} bytes came")
                if data:
                    yield data
                start += len(data)
                if start < end:
                    raise Failed(f"cut short: {end} bytes expected, found {start}")

    def whole(self, address: str, limit: int) -> bytes:
        with _translated():
            data = self._opened.get().cat_file(address, start=0, end=limit + 1, **self._limit)
            if len(data) > limit:
                raise Refused(f"at most {limit} bytes are read, found more")
            return bytes(data)

    def size(self, address: str) -> int:
        with _translated():
            return int(self._opened.get().info(address, **self._limit)["size"])


@contextmanager
def _translated() -> Iterator[None]:
    """Sort what libraries raise by whether another attempt may help."""
    try:
        yield
    except (Failed, Refused, MissingLibrary):
        raise
    except FileNotFoundError as error:
        raise NotThere(_say(error)) from None
    except Exception as error:
        final = isinstance(error, _FINAL) or type(error).__name__ in _FINAL_NAMES
        if final or (isinstance(error, OSError) and error.errno in _FINAL_NUMBERS):
            raise Refused(_say(error)) from None
        raise Failed(_say(error)) from None


def _say(error: Exception) -> str:
    text = (error.strerror if isinstance(error, OSError) else None) or str(error)
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
