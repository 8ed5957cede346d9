"""Figures of benches, read field by field: what is missing or wrong is one line with the file and the field."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NoReturn

from bodyseg_data.core import BadConfig
from bodyseg_data.files import contents, parse_json

LARGEST_FILE_BYTES: Final = 1 << 26
_SHOWN: Final = 60


@dataclass(frozen=True)
class Field:
    """A value of a JSON file and its path there: names of fields and numbers of rows, joined by dots."""

    value: Any
    file: Path
    path: str = ""

    def __getitem__(self, key: str) -> Field:
        """A field of this object. Raises BadConfig if this is none or has no such field."""
        fields = self.items()
        if key not in fields:
            raise BadConfig(f"{self.file}: the field {self._under(key).path!r} is missing")
        return fields[key]

    def get(self, *keys: str) -> Field | None:
        """A nested field; None if it or one of its parents is null or absent."""
        here = self
        for key in keys:
            if not isinstance(here.value, dict) or here.value.get(key) is None:
                return None
            here = here[key]
        return here

    def items(self) -> dict[str, Field]:
        """All fields of this object. Raises BadConfig if it is none."""
        if not isinstance(self.value, dict):
            self.refuse("an object")
        return {key: self._under(key, value) for key, value in self.value.items()}

    def rows(self) -> list[Field]:
        """All entries of this list. Raises BadConfig if it is none."""
        if not isinstance(self.value, list):
            self.refuse("a list")
        return [self._under(str(number), value) for number, value in enumerate(self.value)]

    def number(self, above: float = -math.inf) -> float:
        """A finite number of at least 0, or above `above`. Raises BadConfig."""
        right = not isinstance(self.value, bool) and isinstance(self.value, int | float)
        if not right or not 0 <= self.value < 1e300 or self.value <= above:
            self.refuse(f"a number above {above:g}" if above >= 0 else "a number of at least 0")
        return float(self.value)

    def text(self) -> str:
        """Text. Raises BadConfig."""
        if not isinstance(self.value, str):
            self.refuse("text")
        return str(self.value)

    def flag(self) -> bool:
        """True or false. Raises BadConfig."""
        if not isinstance(self.value, bool):
            self.refuse("true or false")
        return bool(self.value)

    def refuse(self, wanted: str) -> NoReturn:
        """Raise BadConfig that says what this should be and what it is."""
        found = json.dumps(self.value)
        raise BadConfig(f"{self.file}: the field {self.path!r} must be {wanted}, found {found[:_SHOWN]}")

    def _under(self, key: str, value: Any = None) -> Field:
        return Field(value, self.file, f"{self.path}.{key}" if self.path else key)


def read_fields(file: Path) -> Field:
    """The object in a JSON file. Raises BadConfig if it cannot be read or is none."""
    try:
        data = contents(file, packed=False, limit=LARGEST_FILE_BYTES)
    except OSError as error:
        raise BadConfig(f"cannot read {file}: {error.strerror or error}") from error
    if data is None:
        raise BadConfig(f"{file} is larger than {LARGEST_FILE_BYTES} bytes")
    return Field(parse_json(data, str(file)), file)
