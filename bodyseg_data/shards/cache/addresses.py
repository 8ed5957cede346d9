"""What people write to name a set, or some of its shards -> where its files are, and which of them are meant."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.shards.manifest import MANIFEST_NAME
from bodyseg_data.shards.stores.remote import RemoteFolder, RetryPolicy
from bodyseg_data.shards.stores.store import LocalFolder, Store

_ADDRESS: Final = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*)://(.*)", re.DOTALL)


def open_store(
    path: str, options: Mapping[str, Any] | None = None, retry_policy: RetryPolicy | None = None
) -> tuple[Store, str]:
    """The store of a set, and the pattern that the names of its chosen shards match.

    path: a folder, its manifest.json, one of its shards, or a glob that picks some ("shards/train-*.tar"), on this
    machine or behind an address that fsspec knows (https://, s3://, ...). In http addresses `?` begins a query.
    options, retry_policy: of remote sets only; see `RemoteFolder`.

    Raises BadConfig, MissingLibrary.
    """
    address = _ADDRESS.fullmatch(path)
    if address is not None and address[1].lower() != "file":
        folder, pattern = _split_address(address[1].lower(), address[2])
        return RemoteFolder(folder, options or {}, retry_policy or RetryPolicy()), pattern
    if options or retry_policy is not None:
        raise BadConfig(f"storage_options and patience are for remote sets, found them given for {path!r}")
    if address is None:
        place = Path(path)
    elif address[2].startswith("/"):
        place = Path(unquote(address[2]))
    else:
        raise BadConfig(f"a file:// address has a path from the root on, like file:///data/shards, found {path!r}")
    picked = None if place.is_dir() else _pattern(place.name, "*?[")  # a folder may be called anything
    return LocalFolder(place if picked is None else place.parent), picked or "*"


def _split_address(protocol: str, rest: str) -> tuple[str, str]:
    """Address of the folder, and the pattern."""
    mark = query = ""
    if protocol in ("http", "https"):
        rest, mark, query = rest.partition("?")
    parent, slash, last = rest.rpartition("/")
    pattern = _pattern(last, "*[" if protocol in ("http", "https") else "*?[") if slash else None
    return f"{protocol}://{rest if pattern is None else parent}{mark}{query}", pattern or "*"


def _pattern(name: str, marks: str) -> str | None:
    """What the last part of a path picks; None if it is the folder itself."""
    if name == MANIFEST_NAME:
        return "*"
    return name if name.endswith(".tar") or any(mark in name for mark in marks) else None
