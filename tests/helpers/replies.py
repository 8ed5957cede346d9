"""Requests to the tests' HTTP server, its replies, and the faults that tests put into them."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Request:
    """An answered request: path without query, status (444: none was sent), bytes of the body, the Range header."""

    path: str
    status: int
    sent: int
    range: str

    @property
    def start(self) -> int:
        """First byte asked for."""
        match = re.match(r"bytes=(\d+)-", self.range)
        return int(match[1]) if match else 0


@dataclass(frozen=True)
class Reply:
    """Headers that promise `length` bytes, then `body`, and a pause; if bytes are missing, the connection is closed.

    step: bytes sent together, `step_s` seconds before the next ones; None sends all at once.
    """

    body: bytes
    length: int
    content_range: str = ""
    status: int = 206
    pause_s: float = 0.0
    step: int | None = None
    step_s: float = 1.0
    headers: dict[str, str] = field(default_factory=dict)


def refusal(status: int, **headers: str) -> Reply:
    """A reply without a file; underscores in header names stand for hyphens."""
    body = b"refused\n"
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    return Reply(body, len(body), status=status, headers=named)


@dataclass
class Faults:
    """`act` spoils replies; it gets the reply that would be right, and how often the file was asked for before."""

    act: Callable[[Reply, int], Reply] | None = None
    asked: Counter[str] = field(default_factory=Counter)
