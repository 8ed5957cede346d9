"""Measured results that are kept in a file, so that what was cut short carries on and nothing is measured twice.

A result is used again for the same subject, question and code: see `ResultCache`.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from bodyseg_data.core.errors import BadConfig
from bodyseg_model.evaluation.code_digest import code_digest
from bodyseg_model.networks.checkpoints import NETWORK, read_bytes, read_json, write_json

FORMAT: Final = "bodyseg cached results 1"


def network_identity(path: Path) -> dict[str, Any]:
    """The kind and settings of a network and the SHA-256 of its weights, in a run's folder or a .safetensors file.

    Raises BadConfig for a file that is missing or damaged.
    """
    file = path / NETWORK if path.is_dir() else path
    card = read_json(file.with_suffix(".json"))
    weights = hashlib.sha256(read_bytes(file)).hexdigest()
    return {"network": card.get("network"), "settings": card.get("settings"), "weights": weights}


class ResultCache:
    """The results about one subject, in one JSON file that several processes may share.

    subject: what is measured, as JSON, such as `network_identity`; when it changes, the file begins anew. modules: full
    names of those whose code measures; a result is of no use any more when it, or any code that it imports, changes
    (`code_digest`). The file keeps one result a question, so it does not grow as code changes.
    """

    def __init__(self, file: Path, subject: Mapping[str, Any], *modules: str) -> None:
        self._file = file
        self._subject = _as_json(subject)
        self._modules = sorted(set(modules))
        self._code = code_digest(*self._modules)

    def get(self, question: Mapping[str, Any]) -> dict[str, Any] | None:
        """The result of a question; None if it is not there, altered, or of other code.

        question: all that shapes the result beside subject and code, as JSON. Raises BadConfig for a file that holds
        something else.
        """
        key, asked = self._key(question)
        entry = self._read().get(key)
        if not isinstance(entry, dict) or entry != self._entry(asked, entry.get("result")):
            return None
        result: dict[str, Any] = entry["result"]
        return result

    def put(self, question: Mapping[str, Any], result: Mapping[str, Any]) -> None:
        """Keep a result, JSON without NaN, together with what other processes have kept meanwhile.

        Raises BadConfig if the file cannot be written or holds something else.
        """
        key, asked = self._key(question)
        entry = self._entry(asked, _as_json(result))
        with self._locked():
            results = self._read() | {key: entry}
            write_json(self._file, {"format": FORMAT, "subject": self._subject, "results": results})

    def _key(self, question: Mapping[str, Any]) -> tuple[str, Any]:
        """The key of a question, and the question as it comes back from a file."""
        asked = _as_json(question)
        return _digest([self._modules, asked]), asked

    def _entry(self, question: Any, result: Any) -> dict[str, Any]:
        facts = {"question": question, "modules": self._modules, "code": self._code, "result": result}
        return {**facts, "digest": _digest(facts)}

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
        """Hold the lock beside the file, which the system releases if this process is killed."""
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
    """As it comes back from a file. Raises ValueError for NaN, which would equal nothing, not even itself."""
    return json.loads(json.dumps(value, allow_nan=False))


def _digest(value: Any) -> str:
    return hashlib.blake2b(json.dumps(value, sort_keys=True).encode(), digest_size=16).hexdigest()
