"""Cache of measured results in a file, so that an interrupted run carries on and nothing is measured twice.

A result is used again for the same subject, query and code: see `ResultCache`.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from benches.results.code_digest import code_digest
from bodyseg_data.core.errors import BadConfig
from bodyseg_model.networks.checkpoints import NETWORK, read_bytes, read_json, write_json

FORMAT: Final = "bodyseg cached results 1"


def network_identity(path: Path) -> dict[str, Any]:
    """Identify a network in a run's folder or a .safetensors file: its kind, its settings, the SHA-256 of its weights.

    Raises BadConfig for a file that is missing or damaged.
    """
    file = path / NETWORK if path.is_dir() else path
    card = read_json(file.with_suffix(".json"))
    weights = hashlib.sha256(read_bytes(file)).hexdigest()
    return {"network": card.get("network"), "settings": card.get("settings"), "weights": weights}


class ResultCache:
    """Results about one subject, in one JSON file that several processes may share.

    subject: measured object, as JSON, such as `network_identity`; when it changes, the file starts empty. modules: full
    names of the modules that measure; results become invalid when a module, or any that it imports, changes
    (`code_digest`). The file has one result for each query, so it does not grow as code changes.
    """

    def __init__(self, file: Path, subject: Mapping[str, Any], *modules: str) -> None:
        self._file = file
        self._subject = _as_json(subject)
        self._modules = sorted(set(modules))
        self._code = code_digest(*self._modules)

    def __repr__(self) -> str:
        return f"ResultCache({str(self._file)!r}, code {self._code})"

    def get(self, query: Mapping[str, Any]) -> dict[str, Any] | None:
        """Get the result of a query; None if it is missing, altered, or of other code.

        query: everything that the result depends on besides subject and code, as JSON. Raises BadConfig for a file of
        another format.
        """
        key, query = self._key(query)
        entry = self._read().get(key)
        if not isinstance(entry, dict) or entry != self._entry(query, entry.get("result")):
            return None
        result: dict[str, Any] = entry["result"]
        return result

    def put(self, query: Mapping[str, Any], result: Mapping[str, Any]) -> None:
        """Store a result, JSON without NaN, and keep results that other processes have stored meanwhile.

        Raises BadConfig if the file cannot be written or has another format.
        """
        key, query = self._key(query)
        entry = self._entry(query, _as_json(result))
        with self._locked():
            results = self._read() | {key: entry}
            write_json(self._file, {"format": FORMAT, "subject": self._subject, "results": results})

    def _key(self, query: Mapping[str, Any]) -> tuple[str, Any]:
        """The key of a query, and the query as JSON would return it."""
        query = _as_json(query)
        return json_digest([self._modules, query]), query

    def _entry(self, query: Any, result: Any) -> dict[str, Any]:
        facts = {"query": query, "modules": self._modules, "code": self._code, "result": result}
        return {**facts, "digest": json_digest(facts)}

    def _read(self) -> dict[str, Any]:
        if not self._file.exists():
            return {}
        content = read_json(self._file)
        results = content.get("results")
        if content.get("format") != FORMAT or not isinstance(results, dict):
            raise BadConfig(f"{self._file} holds no results of the format {FORMAT!r}: move it away")
        return results if content.get("subject") == self._subject else {}

    @contextlib.contextmanager
    def _locked(self) -> Iterator[None]:
        """Hold a lock file beside the cache; the system releases it if this process is killed."""
        path = self._file.with_name(f".{self._file.name}.lock")
        with contextlib.ExitStack() as stack:
            try:
                lock = stack.enter_context(path.open("ab"))
                fcntl.flock(lock, fcntl.LOCK_EX)
            except OSError as error:
                raise BadConfig(f"cannot lock {path}: {error.strerror or error}") from error
            try:
                yield
            finally:
                fcntl.flock(lock, fcntl.LOCK_UN)  # closing does not release it while a forked process has it open


def _as_json(value: Any) -> Any:
    """Round trip through JSON. Raises ValueError for NaN, which does not equal itself."""
    return json.loads(json.dumps(value, allow_nan=False))


def json_digest(value: Any) -> str:
    """Digest of a value as JSON, keys in alphabetical order, 32 hexadecimal digits."""
    return hashlib.blake2b(json.dumps(value, sort_keys=True).encode(), digest_size=16).hexdigest()
