"""The store of a set at an address: retries resume where an attempt broke off, and messages hold no secrets.

`open_store` opens a set at a path or an address.
"""

from __future__ import annotations

import random
import re
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeVar
from urllib.parse import parse_qsl, unquote, urlsplit

from bodyseg_data.core import BadConfig, BodysegError, Checked, MissingLibrary, bounded, reported
from bodyseg_data.files import last_name
from bodyseg_data.shards.manifest import MANIFEST_NAME
from bodyseg_data.shards.store import TALLY, LocalFolder, Pieces, Stage, Store
from bodyseg_data.shards.transport import FileMissing, PermanentFailure, TransientFailure, open_transport, pinned


class Unreachable(BodysegError):
    """Files of a remote set cannot be fetched: absent, refused, or too many attempts in a row have failed."""

    missing = refused = False  # refused: forbidden or missing: for both, buckets that may not be listed answer 403


_SHORTEST_SECRET: Final = 4

Sink = Callable[[bytes], object]
Pause = Callable[[float], object]
"""Waits for a number of seconds before another attempt; may raise to end the download."""

Result = TypeVar("Result")

_ADDRESS: Final = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*)://(.*)", re.DOTALL)


@dataclass(frozen=True)
class RetryPolicy(Checked):
    """Limits of retries and timeouts for a remote set.

    tries: consecutive failed attempts before giving up. total_s: longest duration of consecutive failures, seconds.
    stall_s: seconds without a byte after which a connection counts as broken.
    first_wait_s: pause after the first failure, seconds; each further pause is twice as long. A random factor of 0.5 to
    1 shortens pauses, so that many processes do not retry at once.
    progress_bytes: an attempt that received as many starts a new count of failures; a server that cuts every connection
    earlier can give files of at most `tries` times as many bytes. Raises BadConfig for a value out of range.
    """

    tries: int = bounded(6, 1)
    total_s: float = bounded(300.0, 0, above=True)
    stall_s: float = bounded(30.0, 0, above=True)
    first_wait_s: float = bounded(0.5, 0, above=True)
    progress_bytes: int = bounded(1 << 16, 1)


class RemoteFolder:
    """Store of a set at an address. It may be forked, pickled and used by several threads.

    url: of the folder; the query of an http address is sent with every file. options: for the fsspec filesystem, such
    as key, secret and endpoint_url; messages show neither these nor the user and query of the address.

    Raises BadConfig for an address or options that fsspec does not accept, MissingLibrary without a required package.
    """

    def __init__(self, url: str, options: Mapping[str, Any], retry_policy: RetryPolicy) -> None:
        protocol, _, rest = url.partition("://")
        rest, mark, query = rest.partition("?") if protocol in ("http", "https") else (rest, "", "")
        self._base, self._query = f"{protocol}://{rest.rstrip('/')}", mark + query
        self._retry_policy, self.pieces = retry_policy, Pieces()
        with reported("not an address", BadConfig, ValueError):
            self._secrets = sorted(_secrets(url, options), key=len, reverse=True)
        self.name = last_name(self._base)
        if protocol == "hf":  # one commit for all reads, also of other processes
            stall_s = retry_policy.stall_s
            self.name, self._base, options = self._with_retries("", lambda _: pinned(self.name, options, stall_s))
            self._secrets = sorted({*self._secrets, *_secrets("", options)}, key=len, reverse=True)
        try:
            self._transport = open_transport(self._base, options, retry_policy.stall_s, retry_policy.total_s)
        except MissingLibrary:
            raise
        except Exception as error:  # filesystems raise errors of their own
            raise BadConfig(f"{self.name}: {self._scrub(str(error))}") from None

    def read(self, name: str, offset: int, length: int) -> bytes:
        """Read bytes `offset` to `offset + length` of a file. Raises Unreachable."""
        read_ahead = self.pieces.take(name, offset, length)
        if read_ahead is not None:
            return read_ahead
        TALLY.came(False)
        data = bytearray()
        self.fetch(name, offset, offset + length, data.extend, ranges=True)
        return bytes(data)

    def fetch(
        self, name: str, start: int, stop: int, sink: Sink, pause: Pause = time.sleep, ranges: bool = False
    ) -> None:
        """Pass bytes `start` to `stop` of a file to `sink`, in chunks, once and in order. Raises Unreachable.

        pause: called with 0 before each chunk and with the seconds to wait before another attempt; what it raises ends
        the download. ranges: refuse a server that ignores them.
        """
        begun = time.perf_counter()
        TALLY.count(Stage.BYTES, stop - start)

        def attempt(address: str) -> None:
            nonlocal start
            TALLY.count(Stage.REQUESTS)
            chunks: Any = self._transport.chunks(address, start, stop, not ranges)
            with closing(chunks):
                for chunk in chunks:
                    pause(0)
                    sink(chunk)
                    start += len(chunk)

        if start < stop:
            self._with_retries(name, attempt, pause, lambda: start)
        TALLY.count(Stage.FETCH, time.perf_counter() - begun)

    def read_file(self, name: str, limit: int) -> bytes | None:
        """Read a whole file of at most `limit` bytes; None if it does not exist. Raises Unreachable."""
        return _unless("missing", lambda: self._with_retries(name, lambda at: self._transport.read_file(at, limit)))

    def size(self, name: str) -> int:
        """Size of a file, bytes. Raises Unreachable."""
        return self._with_retries(name, self._transport.size)

    def find_size(self, name: str) -> int | None:
        """Size of a file, bytes; None if it does not exist. Raises Unreachable."""
        return _unless("missing", lambda: self.size(name))

    def write(self, name: str, content: Path | bytes) -> None:
        """Upload a local file, or some bytes. Raises Unreachable, also for an address that cannot be written."""
        self._with_retries(name, lambda address: self._transport.put(address, content))

    def remove(self, name: str) -> None:
        """Remove a file, which may be missing. Raises Unreachable."""
        _unless("missing", lambda: self._with_retries(name, self._transport.remove))

    def prepare_reread(self, name: str) -> bool:
        return True  # a network may have altered the bytes

    def _with_retries(
        self, name: str, attempt: Callable[[str], Result], pause: Pause = time.sleep, reached: Callable[[], int] = int
    ) -> Result:
        """Call `attempt` with a file's address until it succeeds, by the retry policy. Raises Unreachable.

        reached: position in the file after an attempt; one that got on far begins a new count of failures.
        """
        policy, failures, since, before = self._retry_policy, 0, 0.0, reached()
        while True:
            try:
                return attempt(f"{self._base}/{name}{self._query}")
            except TransientFailure as failure:
                if reached() - before >= policy.progress_bytes or not failures:
                    failures, since = 0, time.monotonic()
                # SystemRandom: the draws on which data depend are not affected, and forked processes wait differently.
                wait = policy.first_wait_s * 2**failures * random.SystemRandom().uniform(0.5, 1.0)
                wait, failures, before = max(wait, failure.wait_s), failures + 1, reached()
                if failures >= policy.tries or time.monotonic() - since + wait > policy.total_s:
                    raise self._unreachable(name, failure, f" ({failures} attempts)") from None
                pause(wait)
            except PermanentFailure as error:
                raise self._unreachable(name, error) from None

    def _unreachable(self, name: str, error: Exception, note: str = "") -> Unreachable:
        found = Unreachable(f"{self.name}/{name}: {self._scrub(str(error))}{note}")
        found.missing, found.refused = isinstance(error, FileMissing), getattr(error, "refused", False)
        return found

    def _scrub(self, text: str) -> str:
        """Reduce a message to one line without secrets."""
        for secret in self._secrets:
            text = text.replace(secret, "***")
        text = re.sub(r"(?<=://)[^/@\s]*@", "", text)
        return " ".join(re.sub(r"(://[^\s?]*)\?\S*", r"\1", text).split())


def read_optional(store: Store, name: str, limit: int) -> bytes | None:
    """Read a file that a set may lack, as `Store.read_file`; None also if it is refused."""
    return _unless("refused", lambda: store.read_file(name, limit))


def _unless(flag: str, read: Callable[[], Result]) -> Result | None:
    """Call `read` and return its result; None if it raises an Unreachable that has `flag`."""
    try:
        return read()
    except Unreachable as error:
        if getattr(error, flag):
            return None
        raise


def _secrets(url: str, options: Mapping[str, Any]) -> set[str]:
    parts = urlsplit(url)
    known = {parts.username or "", parts.password or "", parts.query}
    known.update(value for _, value in parse_qsl(parts.query))
    known.update(_texts(options))
    known.update([unquote(text) for text in known])
    return {text for text in known if len(text) >= _SHORTEST_SECRET and "://" not in text}


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, Mapping):
        for entry in value.values():
            yield from _texts(entry)
    elif isinstance(value, list | tuple):
        for entry in value:
            yield from _texts(entry)
    elif isinstance(value, str):
        yield from {value, value.removeprefix("Bearer ")}
    elif isinstance(value, bytes):
        yield value.decode("utf-8", "replace")


def open_store(
    path: str, options: Mapping[str, Any] | None = None, retry_policy: RetryPolicy | None = None
) -> tuple[Store, str]:
    """Open the store of a set; also returns the pattern that the names of its chosen shards match.

    path: a folder, its manifest.json, one of its shards, or a glob of shards ("shards/train-*.tar"), local or at an
    address of a protocol that fsspec supports (https, s3, ...). In http addresses `?` begins a query.
    options, retry_policy: for remote sets only; see `RemoteFolder`.

    Raises BadConfig, MissingLibrary.
    """
    if not path.strip():
        raise BadConfig(f"a folder or an address must have a name, found {path!r}")
    address = _ADDRESS.fullmatch(path)
    if address is not None and address[1].lower() != "file":
        folder, pattern = _split_address(address[1].lower(), address[2])
        return RemoteFolder(folder, options or {}, retry_policy or RetryPolicy()), pattern
    if options or retry_policy is not None:
        hint = "" if address is not None else ": an address begins with its protocol, as http:// or s3://"
        raise BadConfig(f"storage_options and retry_policy are for remote sets, found them given for {path!r}{hint}")
    if address is None:
        local_path, start = Path(path), path.partition("/")[0]
        if ":" in start and not Path(start).exists():  # as in s3:/bucket, and scp's host:/folder
            raise BadConfig(f"an address has :// in it, a folder of such a name ./ before it, found {path!r}")
    elif address[2].startswith("/"):
        local_path = Path(unquote(address[2]))
    else:
        raise BadConfig(f"a file:// address has a path from the root on, like file:///data/shards, found {path!r}")
    chosen = None if local_path.is_dir() else _pattern(local_path.name, "*?[")  # a folder may have any name
    return LocalFolder(local_path if chosen is None else local_path.parent), chosen or "*"


def _split_address(protocol: str, rest: str) -> tuple[str, str]:
    """Split an address into that of the folder and the pattern."""
    mark = query = ""
    if protocol in ("http", "https"):
        rest, mark, query = rest.partition("?")
    parent, slash, last = rest.rpartition("/")
    pattern = _pattern(last, "*[" if protocol in ("http", "https") else "*?[") if slash else None
    return f"{protocol}://{rest if pattern is None else parent}{mark}{query}", pattern or "*"


def _pattern(name: str, marks: str) -> str | None:
    """Pattern of shards in the last part of a path; None if that is a folder. marks: characters that begin a glob."""
    if name == MANIFEST_NAME:
        return "*"
    return name if name.endswith(".tar") or any(mark in name for mark in marks) else None
