"""Digests of what steps read and make: two products with one digest are the same."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Final

from benches.result_cache import json_digest
from benches.results.step import FINDER, LARGE, PLACES, RESULTS, SHIPPED, Places, Step
from bodyseg_data.core import BadConfig
from bodyseg_data.files import read_json
from bodyseg_data.shards import MANIFEST_NAME
from bodyseg_model.networks import FINDER as FINDER_FILE
from bodyseg_model.networks import SHIPPED as SHIPPED_FILE
from bodyseg_model.networks import RunFiles
from bodyseg_model.networks.checkpoints import LARGE as LARGE_FILE
from bodyseg_model.networks.checkpoints import PLACES as PLACES_FILE

_FILES: Final = {SHIPPED: SHIPPED_FILE, FINDER: FINDER_FILE, LARGE: LARGE_FILE, PLACES: PLACES_FILE}


class Products:
    """Reads digests of products, each file once while its size and time stay the same.

    A set is identified by its manifest, which has the digests of its shards; a training by network, settings and
    weights; all else by the bytes of its files.
    """

    def __init__(self, places: Places) -> None:
        self._places = places
        self._files: dict[tuple[str, int, int], str] = {}

    def made_by(self, step: Step) -> dict[str, str] | None:
        """Product -> digest, as a step has left them in the work folder or in docs/results; None if one is missing."""
        if step.kind == "set":
            manifest = self._places.path(step.name) / MANIFEST_NAME
            return {step.name: self._file(manifest)} if manifest.is_file() else None
        if step.kind == "training":
            network = self._network(self._places.path(step.name) / RunFiles.NETWORK)
            return None if network is None else {step.name: network}
        return self._contents(self._places.path(f"{RESULTS}/{name}") for _, name in step.results)

    def external(self, name: str) -> str | None:
        """Digest of a product that no step makes; None if it is missing."""
        if name in _FILES:
            return self._network(_FILES[name])
        found = self._contents([self._places.path(name)])
        return None if not found else json_digest(found)

    def _network(self, weights: Path) -> str | None:
        """Digest of weights and of what their card says of the network; None without either file."""
        card = weights.with_suffix(".json")
        if not weights.is_file() or not card.is_file():
            return None
        content = read_json(card)
        facts = {name: content.get(name) for name in ("network", "settings", "labels")}
        return json_digest({**facts, "weights": self._file(weights)})

    def _contents(self, paths: Iterable[Path]) -> dict[str, str] | None:
        """Path below its parent -> digest, of files and of all files in folders; None if a path is missing."""
        found: dict[str, str] = {}
        for path in paths:
            if not path.exists():
                return None
            files = [path] if path.is_file() else sorted(each for each in path.rglob("*") if each.is_file())
            found |= {each.relative_to(path.parent).as_posix(): self._file(each) for each in files}
        return found

    def _file(self, path: Path) -> str:
        try:
            facts = path.stat()
            key = str(path), facts.st_size, facts.st_mtime_ns
            if key not in self._files:
                with path.open("rb") as file:
                    digest = hashlib.file_digest(file, partial(hashlib.blake2b, digest_size=16))
                self._files[key] = digest.hexdigest()
        except OSError as error:
            raise BadConfig(f"cannot read {path}: {error.strerror or error}") from error
        return self._files[key]
