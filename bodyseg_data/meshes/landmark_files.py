"""Readers of landmark files of all kinds: JSON by vertex or by coordinate, and the CAESAR survey's .lnd.

A .lnd file holds rows of numbers and names, typed by hand, some names truncated.
The rows stand between a line that begins with "AUX =" and one that begins with "END =". Each holds some numbers, the
last three of which are x, y, z in millimetres, and a name, which may hold blanks or begin with a digit:

    3  0  0  1   12.3  -101.2  1544.0  Rt. Thelion/Bustpoin

A name is recognised if it is one of the 33 in full, regardless of case, blanks and punctuation, or a prefix of only one
of them, or differs from one by a letter or two and from all others of its side by clearly more. Sides and numbers, like
the "II" of a toe, must be exact. So none of the survey's 40 other names, cut or misspelt by a letter, is taken for one.
"""

import math
import re
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np

from bodyseg_data.core import BadLandmarks
from bodyseg_data.labels import LANDMARKS
from bodyseg_data.meshes.landmarks import (
    METRES,
    LandmarkSet,
    PointLandmarks,
    json_table,
    parse_landmarks,
    parse_points,
)
from bodyseg_data.meshes.mesh_files import file_bytes

LARGEST_BYTES: Final = 1 << 20
"""Largest size of a landmark file, also after unpacking: those of the survey have a hundredth of it."""

_SIDES: Final = {"rt": "rt", "right": "rt", "lt": "lt", "left": "lt"}
_PLACEHOLDER_MM: Final = -999.0
_LEAST_SHARE: Final = 0.6  # of a name that a truncated one must have
_LONGEST_NAME: Final = 60  # twice the survey's longest; the edit distance takes quadratic time
_MARGIN: Final = 2  # letters by which a misspelt name must be nearer to one than to the next
_AUX: Final = re.compile(r"\s*AUX\s*=", re.IGNORECASE)
_END: Final = re.compile(r"\s*END\s*=", re.IGNORECASE)


def read_lnd(path: Path) -> PointLandmarks:
    """Read a .lnd file (or .lnd.gz): the points in metres, in the frame of the survey's scan of the same subject.

    Landmarks that are not among the 33 are left out, and so are rows without coordinates (-999, all 0, or not
    numbers). Raises BadLandmarks, naming the file and the landmarks, for one that is missing or given twice in
    different places, and for a file that cannot be read or lacks the lines "AUX =" and "END =".
    """
    found: dict[str, tuple[float, ...]] = {}
    text = file_bytes(path, ".lnd", LARGEST_BYTES, BadLandmarks).decode("latin-1")
    for number, point, written in _rows(text, path):
        name = recognise(written)
        if name is None or _is_placeholder(point):
            continue
        if name in found and found[name] != point:
            raise BadLandmarks(f"landmarks {path}, line {number}: {name!r} is given twice, {found[name]} and {point}")
        found[name] = point
    missing = [name for name in LANDMARKS if name not in found]
    if missing:
        raise BadLandmarks(f"landmarks {path}: {', '.join(map(repr, missing))} missing")
    return PointLandmarks(str(path), np.array([found[name] for name in LANDMARKS]) * METRES["mm"])


@lru_cache(maxsize=4096)
def recognise(written: str) -> str | None:
    """Find the one of the 33 that a name in a file means; None if it is not certain."""
    if len(written) > _LONGEST_NAME:
        return None
    side, words = _normalised(written.partition("#")[0])
    names = {known: words for known, (its_side, words) in _KNOWN.items() if its_side == side}
    exact = [known for known, other in names.items() if other == words]
    if exact:
        return exact[0]
    whole = " ".join(words)
    whole_names = {known: " ".join(other) for known, other in names.items()}
    cut = [known for known, other in whole_names.items() if other.startswith(whole)]
    if cut:
        other = whole_names[cut[0]]
        enough = len(cut) == 1 and len(whole) >= max(3, _LEAST_SHARE * len(other))
        return cut[0] if enough and set(_numbers(words)) <= set(_numbers(other.split())) else None
    distances = sorted((_edits(whole, other), known) for known, other in whole_names.items())
    (edits, nearest), (next_edits, _) = distances[:2]
    allowed = 0 if len(whole) < 6 else 1 if len(whole) < 10 else 2
    same_numbers = _numbers(words) == _numbers(names[nearest])
    return nearest if edits <= allowed and next_edits >= edits + _MARGIN and same_numbers else None


def _normalised(name: str) -> tuple[str, tuple[str, ...]]:
    """Split a name into side ("rt", "lt" or "") and other words, in lower case without punctuation."""
    words = tuple(re.findall(r"[^\W_]+", name.lower()))
    side = _SIDES.get(words[0], "") if words else ""
    return side, words[1:] if side else words


def _numbers(words: tuple[str, ...] | list[str]) -> list[str]:
    """Words that are numbers, Roman or Arabic: a different number means another landmark, not a misspelling."""
    return [word for word in words if re.fullmatch(r"[ivx]+|\d+\w*", word)]


def _edits(a: str, b: str) -> int:
    """Edit distance: the least number of letters to add, remove or change (Levenshtein 1966)."""
    row = list(range(len(b) + 1))
    for i, left in enumerate(a, 1):
        diagonal, row[0] = row[0], i
        for j, right in enumerate(b, 1):
            diagonal, row[j] = row[j], min(row[j] + 1, row[j - 1] + 1, diagonal + (left != right))
    return row[-1]


_KNOWN: Final = {name: _normalised(name) for name in LANDMARKS}


def _rows(text: str, path: Path) -> Iterator[tuple[int, tuple[float, ...], str]]:
    """Line number, x y z in millimetres and name as written, of every row that has coordinates and a name."""
    lines = list(enumerate(text.splitlines(), 1))
    begin = next((number for number, line in lines if _AUX.match(line)), None)
    end = next((number for number, line in lines if begin and number > begin and _END.match(line)), None)
    if begin is None or end is None:
        lacking = "AUX =" if begin is None else "END ="
        raise BadLandmarks(f"landmarks {path}: rows must stand between 'AUX =' and 'END =', found no {lacking!r}")
    for number, line in lines[begin : end - 1]:
        words = line.split()
        count = next((index for index, word in enumerate(words) if not _is_number(word)), len(words))
        if 3 <= count < len(words):
            yield number, tuple(float(word) for word in words[count - 3 : count]), " ".join(words[count:])


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _is_placeholder(point: tuple[float, ...]) -> bool:
    return not any(point) or any(not math.isfinite(value) or value == _PLACEHOLDER_MM for value in point)


def load_landmark_file(path: Path) -> LandmarkSet | PointLandmarks:
    """Read a landmark file: .lnd (or .lnd.gz), or .json, by vertex or, if it has "points", by coordinate.

    Raises BadLandmarks, naming the file and, where there is one, the landmark at fault.
    """
    name = path.name.lower().removesuffix(".gz")
    if name.endswith(".lnd"):
        return read_lnd(path)
    if path.suffix.lower() != ".json":
        raise BadLandmarks(f"a landmark file must be .json, .lnd or .lnd.gz, found {path}")
    data = file_bytes(path, "landmark", LARGEST_BYTES, BadLandmarks)
    return (parse_points if json_table(data, str(path)).has("points") else parse_landmarks)(data, str(path))
