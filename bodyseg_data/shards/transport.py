"""Single attempts to download and upload bytes through fsspec: HTTP as a stream, other protocols in blocks.

Forks share no event loop, session or socket: every process, where needed every thread, opens a filesystem on first use.
"""

import errno
import inspect
import os
import re
import threading
import time
import uuid
import weakref
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote

from bodyseg_data.core import BadConfig, MissingLibrary
from bodyseg_data.files import web_page
from bodyseg_data.machine import required

_FILESYSTEMS: dict[tuple[int, str, int], Any] = {}
"""Filesystems by process, token and thread, 0 for those that threads share.

A fork keeps but never uses its parent's: closing it would affect the parent.
"""

_CHUNK_BYTES: Final = 1 << 20
_CHUNK_S: Final = 0.2
_BLOCK_BYTES: Final = 4 << 20
"""Size of requests to filesystems that give no partial ranges: the most that a broken connection loses."""

_TRANSIENT_STATUSES: Final = frozenset({408, 425, 429, *range(500, 600)})
_PERMANENT_ERRORS: Final = (PermissionError, IsADirectoryError, ValueError, TypeError, NotImplementedError)
_PERMANENT_ERROR_NAMES: Final = frozenset(
    {"NoCredentialsError", "PartialCredentialsError", "ProfileNotFound", "ParamValidationError", "TooManyRedirects"}
)
_PERMANENT_ERRNOS: Final = frozenset({errno.EINVAL, errno.ENOSYS})
_LISTINGS: Final = frozenset({"use_listings_cache", "listings_expiry_time", "max_paths"})
_HUB_FOLDER: Final = re.compile(r"hf://datasets/([^/@]+/[^/@]+)(?:@([^/]+))?((?:/.*)?)")
_CONTENT_RANGE: Final = re.compile(r"bytes ([0-9]{1,19})-([0-9]{1,19})/([0-9]{1,19}|\*)")


class Filesystem:
    """An fsspec filesystem that every process opens for itself; only its options are pickled.

    Every thread has its own, too, unless the filesystem is asynchronous: others may talk over a single connection.
    """

    def __init__(self, address: str, options: Mapping[str, Any]) -> None:
        self._address, self._options = address, dict(options)
        self._token = uuid.uuid4().hex
        weakref.finalize(self, _forget, self._token)

    def get(self) -> Any:
        process = os.getpid()
        for thread in (0, threading.get_ident()):
            if (process, self._token, thread) in _FILESYSTEMS:
                return _FILESYSTEMS[process, self._token, thread]
        opened = self._open()
        thread = 0 if getattr(opened, "async_impl", False) else threading.get_ident()
        return _FILESYSTEMS.setdefault((process, self._token, thread), opened)

    def _open(self) -> Any:
        protocol = self._address.partition("://")[0]
        try:
            kind = import_module("fsspec").get_filesystem_class(protocol)
            # Host, port and user, for protocols whose filesystem is bound to one server.
            options = {} if protocol in ("http", "https") else kind._get_kwargs_from_urls(self._address)
            options = import_module("fsspec.config").apply_config(kind, options | self._options)
            # Checked first: an object whose construction fails would print an error when it is deleted, too.
            inspect.signature(kind.__init__).bind(None, **options)
            filesystem = kind(skip_instance_cache=True, **options)
        except ImportError as error:
            packages = "pip install 'bodyseg[remote]' has those of http and s3"
            raise MissingLibrary(f"{protocol}:// addresses need packages: {packages} ({error})") from None
        if hasattr(filesystem, "retries"):
            filesystem.retries = 1  # s3fs: attempts are counted by the caller
        return filesystem


def _forget(token: str) -> None:
    for key in [key for key in _FILESYSTEMS if key[:2] == (os.getpid(), token)]:
        opened = _FILESYSTEMS.pop(key)
        if getattr(opened, "async_impl", False):
            # It refers to itself, so the garbage collector would free and close it, in a fork waiting for its loop.
            vars(opened).clear()


class TransientFailure(Exception):
    """Failure that another attempt may avoid. wait_s: pause that the server demands, seconds."""

    def __init__(self, problem: str, wait_s: float = 0.0) -> None:
        super().__init__(problem)
        self.wait_s = wait_s


class PermanentFailure(Exception):
    """Failure that every further attempt would repeat. refused: the file may not be read, or may not be looked for."""

    def __init__(self, problem: str, refused: bool = False) -> None:
        super().__init__(problem)
        self.refused = refused


class FileMissing(PermanentFailure):
    """The file does not exist."""


class HttpTransport:
    """Streaming through aiohttp, in fsspec's session and thread, that keeps the bytes before a broken connection.

    fsspec's own `cat_file` and `open` lose these, and do not check the received range (figures:
    docs/reference/dependencies.md). Methods take full addresses; they raise TransientFailure or PermanentFailure.
    """

    def __init__(self, filesystem: Filesystem, stall_s: float) -> None:
        self._filesystem, self._stall_s = filesystem, stall_s
        filesystem.get()

    def chunks(self, address: str, start: int, stop: int, allow_whole_file: bool) -> Iterator[bytes]:
        """Iterate over bytes `start` to `stop` in order; those before an error are valid.

        allow_whole_file: from a server without byte ranges, skip the bytes before `start` instead of failing.
        """
        with _classified_errors(), self._response(address, start, stop) as (response, chunk, problem):
            position = start if response.status == 206 else 0
            if position == 0 and (found := web_page(chunk)):
                raise PermanentFailure(found)
            if response.status != 206 and not allow_whole_file:
                raise PermanentFailure("the server ignores byte ranges: use a cache for whole shards, or bodyseg pull")
            while True:
                selected = chunk[max(start - position, 0) : stop - position]
                position += len(chunk)
                if selected:
                    yield selected
                if position >= stop:
                    return
                if problem is not None:
                    raise problem
                if not chunk:
                    raise TransientFailure(f"cut short: {stop} bytes expected, found {position}")
                chunk, problem = self._run(_read_chunk, response)

    def read_file(self, address: str, limit: int) -> bytes:
        data = bytearray()
        with _classified_errors(), self._response(address, None, None) as (response, chunk, problem):
            while chunk or problem is not None:
                data += chunk
                if len(data) > limit:
                    raise PermanentFailure(f"at most {limit} bytes are read, found more")
                if problem is not None:
                    raise problem
                chunk, problem = self._run(_read_chunk, response)
        return bytes(data)

    def size(self, address: str) -> int:
        with _classified_errors(), self._response(address, 0, 1) as (response, _, _):
            if response.status == 206:
                total = response.headers.get("Content-Range", "").rpartition("/")[2]
            else:
                total = response.headers.get("Content-Length", "")
            if not re.fullmatch(r"[0-9]{1,19}", total):
                raise PermanentFailure("the server does not say how large the file is")
            return int(total)

    def put(self, address: str, content: Path | bytes) -> None:
        raise PermanentFailure("http addresses are read, not written")

    def remove(self, address: str) -> None:
        raise PermanentFailure("http addresses are read, not written")

    @contextmanager
    def _response(self, address: str, start: int | None, stop: int | None) -> Iterator[tuple[Any, bytes, Any]]:
        """Request a file; gives the response and the first result of `_read_chunk`."""
        response, chunk, problem = self._run(self._request, address, start, stop)
        try:
            _check_response(response, start, stop)
            yield response, chunk, problem
        finally:
            self._run(_close, response)

    async def _request(self, address: str, start: int | None, stop: int | None) -> tuple[Any, bytes, Any]:
        filesystem = self._filesystem.get()
        session = await filesystem.set_session()
        # aiohttp gets the options of neither the filesystem nor its listings.
        own = inspect.signature(type(filesystem).__init__).parameters.keys() | _LISTINGS
        request = {name: value for name, value in filesystem.storage_options.items() if name not in own}
        headers = {**(request.pop("headers", None) or {}), "Accept-Encoding": "identity"}
        if start is not None and stop is not None:
            headers["Range"] = f"bytes={start}-{stop - 1}"
        if "timeout" not in request:
            timeout = import_module("aiohttp").ClientTimeout
            request["timeout"] = timeout(total=None, sock_connect=self._stall_s, sock_read=self._stall_s)
        encoded = bool(filesystem.storage_options.get("encoded", False))
        url = import_module("yarl").URL(address, encoded=encoded)
        response = await session.get(url, headers=headers, **request)
        return response, *await _read_chunk(response)

    def _run(self, work: Any, *arguments: Any) -> Any:
        return import_module("fsspec.asyn").sync(self._filesystem.get().loop, work, *arguments)


async def _read_chunk(response: Any) -> tuple[bytes, Exception | None]:
    """Read some bytes, and the error after them; neither at the end.

    It reads for `_CHUNK_S` seconds at once, since a stream that breaks drops the bytes that are still buffered.
    """
    data = bytearray()
    until = time.monotonic() + _CHUNK_S
    try:
        while len(data) < _CHUNK_BYTES and time.monotonic() < until:
            chunk = await response.content.readany()
            if not chunk:
                break
            data += chunk
    except Exception as error:
        return bytes(data), error
    return bytes(data), None


async def _close(response: Any) -> None:
    """Return the connection to the pool if all was read, else close it."""
    response.close()


def _check_response(response: Any, start: int | None, stop: int | None) -> None:
    status = response.status
    if status in (404, 410):
        raise FileMissing(f"{status} {response.reason}")
    if status == 416:
        size = response.headers.get("Content-Range", "").rpartition("/")[2]
        found = size if re.fullmatch(r"[0-9]{1,19}", size) else f"{start} or fewer"
        raise TransientFailure(f"cut short: {stop} bytes or more expected, found {found}")
    if status in _TRANSIENT_STATUSES:
        wait = response.headers.get("Retry-After", "")
        raise TransientFailure(f"{status} {response.reason}", float(wait) if re.fullmatch(r"[0-9]{1,6}", wait) else 0.0)
    if status not in (200, 206) or (start is None and status == 206):
        raise PermanentFailure(f"{status} {response.reason}", refused=status == 403)
    if response.headers.get("Content-Encoding", "identity") != "identity":
        raise PermanentFailure(
            f"the server sends it packed ({response.headers['Content-Encoding']}), though asked not to"
        )
    if status == 206:
        found = response.headers.get("Content-Range", "")
        match = _CONTENT_RANGE.fullmatch(found)
        if match is None or int(match[1]) != start:
            raise TransientFailure(f"bytes {start} to {stop} asked for, found Content-Range {found!r}")


class BlockTransport:
    """As `HttpTransport`, through any other filesystem of fsspec."""

    def __init__(self, filesystem: Filesystem, total_s: float) -> None:
        self._filesystem = filesystem
        # Most asynchronous filesystems time out by themselves; this limit is for the others.
        self._limit = {"timeout": total_s} if getattr(filesystem.get(), "async_impl", False) else {}

    def chunks(self, address: str, start: int, stop: int, allow_whole_file: bool) -> Iterator[bytes]:
        with _classified_errors():
            while start < stop:
                end = min(start + _BLOCK_BYTES, stop)
                data = self._filesystem.get().cat_file(address, start=start, end=end, **self._limit)
                if len(data) > end - start:
                    raise TransientFailure(f"bytes {start} to {end} asked for, {len(data)} bytes came")
                if data:
                    yield data
                start += len(data)
                if start < end:
                    raise TransientFailure(f"cut short: {end} bytes expected, found {start}")

    def read_file(self, address: str, limit: int) -> bytes:
        with _classified_errors():
            data = self._filesystem.get().cat_file(address, start=0, end=limit + 1, **self._limit)
            if len(data) > limit:
                raise PermanentFailure(f"at most {limit} bytes are read, found more")
            return bytes(data)

    def size(self, address: str) -> int:
        with _classified_errors():
            return int(self._filesystem.get().info(address, **self._limit)["size"])

    def put(self, address: str, content: Path | bytes) -> None:
        with _classified_errors():
            filesystem = self._filesystem.get()
            # Of an address, fsspec's SFTP makes files and folders whose names hold all of it, the password, too.
            path = filesystem._strip_protocol(address)
            if not getattr(filesystem, "async_impl", False):  # stores of objects are asynchronous, and have no folders
                filesystem.makedirs(path.rpartition("/")[0], exist_ok=True)
            if isinstance(content, bytes):
                filesystem.pipe_file(path, content)
            else:
                filesystem.put_file(str(content), path)

    def remove(self, address: str) -> None:
        with _classified_errors():
            filesystem = self._filesystem.get()
            filesystem.rm_file(filesystem._strip_protocol(address))


Transport = HttpTransport | BlockTransport


def open_transport(address: str, options: Mapping[str, Any], stall_s: float, total_s: float) -> Transport:
    """Open the transport to a folder. Raises MissingLibrary, or what the filesystem raises for address or `options`."""
    protocol = address.partition("://")[0]
    if protocol in ("http", "https"):
        return HttpTransport(Filesystem(address, options), stall_s)
    if protocol in ("s3", "s3a"):
        waits = {"connect_timeout": stall_s, "read_timeout": stall_s, "retries": {"total_max_attempts": 1}}
        options = {**options, "config_kwargs": {**waits, **options.get("config_kwargs", {})}}
    return BlockTransport(Filesystem(address, options), total_s)


@contextmanager
def _classified_errors() -> Iterator[None]:
    """Convert errors of libraries to TransientFailure, PermanentFailure or FileMissing."""
    try:
        yield
    except (TransientFailure, PermanentFailure, MissingLibrary):
        raise
    except FileNotFoundError as error:
        raise FileMissing(_describe(error)) from None
    except Exception as error:
        final = isinstance(error, _PERMANENT_ERRORS) or type(error).__name__ in _PERMANENT_ERROR_NAMES
        if final or (isinstance(error, OSError) and error.errno in _PERMANENT_ERRNOS):
            raise PermanentFailure(_describe(error), isinstance(error, PermissionError)) from None
        raise TransientFailure(_describe(error)) from None


def _describe(error: Exception) -> str:
    text = (error.strerror if isinstance(error, OSError) else None) or str(error)
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def pinned(url: str, options: Mapping[str, Any], timeout_s: float) -> tuple[str, str, dict[str, Any]]:
    """Pin a folder on the Hugging Face hub: its address with a commit for the revision, that of http, and its options.

    The hub's own file system reads 5 MB ahead of every range, and begins anew when a connection breaks. options:
    `token` and `endpoint` (else HF_TOKEN, HF_ENDPOINT), and those of http addresses. Raises BadConfig for another
    address, MissingLibrary, TransientFailure, PermanentFailure.
    """
    match = _HUB_FOLDER.fullmatch(url)
    if match is None:
        raise BadConfig(f"an address of the hub must be hf://datasets/OWNER/NAME[@REVISION][/FOLDER], found {url}")
    hub = required("huggingface_hub", "hf:// addresses", "hub")
    name, revision, rest = match[1], unquote(match[2] or "main"), dict(options)
    token, endpoint = rest.pop("token", None), rest.pop("endpoint", None) or os.environ.get("HF_ENDPOINT")
    api = hub.HfApi(endpoint=endpoint, token=token)
    try:
        commit = str(api.dataset_info(name, revision=revision, timeout=timeout_s).sha)
    except Exception as error:  # of the hub, and of the library that it connects by
        status = getattr(getattr(error, "response", None), "status_code", None)
        passes = status in _TRANSIENT_STATUSES if status else not isinstance(error, ValueError)
        asked = f"{status} for revision {revision!r}: is it there, and may the token (HF_TOKEN) read it?"
        raise (TransientFailure if passes else PermanentFailure)(asked if status else repr(error)) from None
    if not re.fullmatch("[0-9a-f]{40}", commit):
        raise PermanentFailure(f"the hub must name a commit of 40 digits, found {commit[:60]!r}")
    headers = {**hub.utils.build_hf_headers(token=token), **rest.pop("headers", {})}
    address = hub.hf_hub_url(name, match[3].strip("/"), repo_type="dataset", revision=commit, endpoint=api.endpoint)
    return f"hf://datasets/{name}@{commit}{match[3].rstrip('/')}", address.rstrip("/"), {**rest, "headers": headers}
