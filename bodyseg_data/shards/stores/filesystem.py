"""Filesystems of fsspec, opened by every process, and where needed by every thread, for itself."""

from __future__ import annotations

import inspect
import os
import threading
import uuid
import weakref
from collections.abc import Mapping
from importlib import import_module
from typing import Any

from bodyseg_data.core.errors import MissingLibrary

_FILESYSTEMS: dict[tuple[int, str, int], Any] = {}
"""Filesystems by process, token and thread, 0 for those that threads share.

A fork keeps but never uses its parent's: closing it would affect the parent.
"""


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
            # Host, port and user, for the protocols whose filesystem is one server's.
            options = {} if protocol in ("http", "https") else kind._get_kwargs_from_urls(self._address)
            options |= self._options
            # Before an object is made: one whose construction fails fails again when it is deleted, on standard error.
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
        del _FILESYSTEMS[key]
