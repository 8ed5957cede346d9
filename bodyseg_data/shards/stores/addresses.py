"""Parsing of the path or address of a set into its store and the pattern of the chosen shards."""

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
    """Open the store of a set; also returns the pattern that the names of its chosen shards match.

    path: a folder, its manifest.json, one of its shards, or a glob of shards ("shards/train-*.tar"), local or at an
    address of a protocol that fsspec supports (https://, s3://, ...). In http addresses `?` begins a query.
    options, retry_policy: for remote sets only; see `RemoteFolder`.

    Raises BadConfig, MissingLibrary.
    """
    address = _ADDRESS.fullmatch(path)
    if address is not None and address[1].lower() != "file":
        folder, pattern = _split_address(address[1].lower(), address[2])
        return RemoteFolder(folder, options or {}, retry_policy or RetryPolicy()), pattern
    if options or retry_policy is not None:
        raise BadConfig(f"storage_options and retry_policy are for remote sets, found them given for {path!r}")
    if address is None:
        local_path = Path(path)
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
