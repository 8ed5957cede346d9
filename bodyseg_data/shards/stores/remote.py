"""A set's files behind an address: retries that carry on where an attempt broke, and messages without secrets."""

from __future__ import annotations

import math
import random
import re
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from typing import Any, Final, TypeVar
from urllib.parse import parse_qsl, unquote, urlsplit

from bodyseg_data.core.errors import BadConfig, MissingLibrary, Unreachable
from bodyseg_data.shards.stores.transport import Failed, NotThere, Refused, open_transport

_SHORTEST_SECRET: Final = 4

Answer = TypeVar("Answer")


@dataclass(frozen=True)
class RetryPolicy:
    """How much trouble on the way to a remote set is borne.

    tries: attempts in a row that may bring next to nothing. total_s: seconds such a row may last. stall_s: seconds
    without a byte after which a connection counts as broken. first_wait_s: pause after a first failure; every further
    pause is twice as long. By chance pauses are up to half shorter, so that many processes do not come back at once.
    progress_bytes: an attempt that brought as many was not in vain and begins a new row; of a server that cuts every
    connection after fewer, nothing larger than `tries` times as many can be had.

    Raises BadConfig.
    """

    tries: int = 6
    total_s: float = 300.0
    stall_s: float = 30.0
    first_wait_s: float = 0.5
    progress_bytes: int = 1 << 16

    def __post_init__(self) -> None:
        for name in ("tries", "progress_bytes"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise BadConfig(f"Patience: {name} must be a whole number of at least 1, found {value!r}")
        for name in ("total_s", "stall_s", "first_wait_s"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < math.inf:
                raise BadConfig(f"Patience: {name} must be a positive number of seconds, found {value!r}")


class RemoteFolder:
    """The files of a set behind an address. May be forked, pickled and used by several threads.

    url: of the folder; the query of an http address is sent with every file. options: for the fsspec filesystem, such
    as key, secret and endpoint_url; neither they nor the user and query of the address show in messages.

    Raises BadConfig for an address or options that fsspec does not take, MissingLibrary for a package that is missing.
    """

    def __init__(self, url: str, options: Mapping[str, Any], retry_policy: RetryPolicy) -> None:
        protocol, _, rest = url.partition("://")
        rest, mark, query = rest.partition("?") if protocol in ("http", "https") else (rest, "", "")
        self._base, self._query = f"{protocol}://{rest.rstrip('/')}", mark + query
        self._retry_policy = retry_policy
        try:
            self._secrets = sorted(_secrets(url, options), key=len, reverse=True)
        except ValueError as error:
            raise BadConfig(f"not an address: {error}") from None
        self.name = re.sub(r"(?<=://)[^/@]*@", "", self._base)
        try:
            self._transport = open_transport(protocol, options, retry_policy.stall_s, retry_policy.total_s)
        except MissingLibrary:
            raise
        except Exception as error:  # every filesystem has its own
            raise BadConfig(f"{self.name}: {self._scrub(str(error))}") from None

    def read(self, name: str, offset: int, length: int) -> bytes:
        """Bytes `offset` to `offset + length` of a file. Raises Unreachable."""
        data = bytearray()
        self._fetch(name, offset, offset + length, data.extend, skips=False)
        return bytes(data)

    def fetch(self, name: str, start: int, stop: int, sink: Callable[[bytes], object]) -> None:
        """Give bytes `start` to `stop` of a file to `sink`, piece by piece, once and in order. Raises Unreachable."""
        self._fetch(name, start, stop, sink, skips=True)

    def whole(self, name: str, limit: int) -> bytes | None:
        """A file of at most `limit` bytes, None if there is none. Raises Unreachable."""
        try:
            return self._persist(name, lambda address: self._transport.whole(address, limit))
        except NotThere:
            return None

    def size(self, name: str) -> int:
        """Bytes of a file. Raises Unreachable."""
        try:
            return self._persist(name, self._transport.size)
        except NotThere as error:
            raise self._unreachable(name, error) from None

    def doubt(self, name: str) -> bool:
        """Whether to read again may help where what was read is wrong."""
        return True

    def _fetch(self, name: str, start: int, stop: int, sink: Callable[[bytes], object], skips: bool) -> None:
        row = _Row(self._retry_policy)
        while start < stop:
            begun = start
            try:
                with closing(self._pieces(name, start, stop, skips)) as pieces:
                    for piece in pieces:
                        sink(piece)
                        start += len(piece)
            except Failed as failure:
                self._bear(row, failure, name, start - begun)
            except Refused as error:
                raise self._unreachable(name, error) from None

    def _pieces(self, name: str, start: int, stop: int, skips: bool) -> Any:
        return self._transport.pieces(f"{self._base}/{name}{self._query}", start, stop, skips)

    def _persist(self, name: str, attempt: Callable[[str], Answer]) -> Answer:
        row = _Row(self._retry_policy)
        while True:
            try:
                return attempt(f"{self._base}/{name}{self._query}")
            except Failed as failure:
                self._bear(row, failure, name, 0)
            except NotThere:
                raise
            except Refused as error:
                raise self._unreachable(name, error) from None

    def _bear(self, row: _Row, failure: Failed, name: str, brought: int) -> None:
        wait = row.wait_after(failure, brought)
        if wait is None:
            raise self._unreachable(name, failure, f" ({row.failures} attempts)") from None
        time.sleep(wait)

    def _unreachable(self, name: str, error: Exception, note: str = "") -> Unreachable:
        return Unreachable(f"{self.name}/{name}: {self._scrub(str(error))}{note}")

    def _scrub(self, text: str) -> str:
        """One line without secrets."""
        for secret in self._secrets:
            text = text.replace(secret, "***")
        text = re.sub(r"(?<=://)[^/@\s]*@", "", text)
        return " ".join(re.sub(r"(://[^\s?]*)\?\S*", r"\1", text).split())


class _Row:
    """Failures one after the other, until something comes of an attempt."""

    def __init__(self, retry_policy: RetryPolicy) -> None:
        self._retry_policy = retry_policy
        self.failures = 0
        self._since = 0.0

    def wait_after(self, failure: Failed, brought: int) -> float | None:
        """Seconds to wait before the next attempt; None to give up."""
        if brought >= self._retry_policy.progress_bytes or not self.failures:
            self.failures, self._since = 0, time.monotonic()
        self.failures += 1
        if self.failures >= self._retry_policy.tries:
            return None
        # The system's own randomness: draws that data depend on are left alone, and forks do not wait alike.
        pause = self._retry_policy.first_wait_s * 2 ** (self.failures - 1) * random.SystemRandom().uniform(0.5, 1.0)
        wait = max(pause, failure.wait_s)
        return wait if time.monotonic() - self._since + wait <= self._retry_policy.total_s else None


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
        yield value
    elif isinstance(value, bytes):
        yield value.decode("utf-8", "replace")
