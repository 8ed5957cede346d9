"""Results whose labels are not those of today: the landmarks of the open body have changed since."""

from __future__ import annotations

import json
from collections.abc import Iterable
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

from benches.result_cache import json_digest
from bodyseg_data.core.errors import BadConfig

RECORDS: Final = "steps.json"
"""In the folder of results: the step that made each of them, see `benches.results.records`."""


@cache
def landmarks_digest() -> str:
    """Digest of the open body's landmarks, from which its labels follow."""
    data = (files("bodyseg_data.meshes.landmarks") / "sets" / "open.json").read_bytes()
    return json_digest(json.loads(data))


def read_records(path: Path) -> dict[str, Any]:
    """Step -> record as JSON; none if there is no such file. Raises BadConfig for a file that holds no records."""
    if not path.exists():
        return {}
    try:
        steps = json.loads(path.read_text(encoding="utf-8"))["steps"]
        if not all(isinstance(record["made"], dict) for record in steps.values()):
            raise TypeError("made must be a table")
    except (OSError, ValueError, TypeError, LookupError, AttributeError) as error:
        raise BadConfig(f"{path} holds no records of steps: {error!r}") from error
    return dict(steps)


def outdated(folder: Path, results: Iterable[str]) -> str:
    """A sentence that names those of `results` (JSON files of `folder`) that have other labels; "" if none has."""
    landmarks = landmarks_digest()
    old = {
        file
        for record in read_records(folder / RECORDS).values()
        if record.get("landmarks") != landmarks
        for file in record["made"]
    }
    names = [f"[{name}]({name})" for name in results if name in old]
    if not names:
        return ""
    return (
        "**Made before the last change of the open body's landmarks**, and so with other labels than a set that is "
        f"packed today: {', '.join(names)}. `tools/bench all` makes them anew.\n"
    )
