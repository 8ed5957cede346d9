"""A page of results whose every number is read out of the JSON beside it, so that page and figures cannot part.

A template is Markdown with places like these:

    {{network.json networks.compact.cpu_ms .1}}         a number with one decimal
    {{compact.json average_per_class_accuracy %1}}      a share in per cent with one decimal
    {{loader.json bytes_per_sample.ours_all 0}}         a whole number, thousands apart
    {{network.json command text}}                       as it is
    {{network.json times[task=scores][threads=2].ms .1}}    of a list, the first entry that has these values
    {{loader.json samples_per_second.ours_all.2 / samples_per_second.memory.2 .2}}    one number over another
"""

from __future__ import annotations

import json
import re
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

from bodyseg_data.errors import BadConfig

_PLACE: Final = re.compile(r"\{\{(.+?)\}\}")
_STEP: Final = re.compile(r"\.?([^.\[\]]+)|\[([^=\[\]]+)=([^\[\]]*)\]")
_THIN_SPACE: Final = " "


def render_page(template: str, folder: Path) -> str:
    """The template with every place filled from the JSON files of `folder`.

    Raises BadConfig, naming the place, for a file that is not there or no JSON, a value that it does not have, or one
    that does not fit its format.
    """
    files = lru_cache(maxsize=None)(lambda name: _read(folder / name))
    return _PLACE.sub(lambda place: _fill(place[1], files), template)


def sources_of(template: str) -> list[str]:
    """The JSON files that a template reads, each once, in alphabetical order."""
    return sorted({place[1].split()[0] for place in _PLACE.finditer(template)})


def _fill(place: str, files: Any) -> str:
    words = place.split()
    try:
        if len(words) == 5 and words[2] == "/":
            over = _find(files(words[0]), words[3])
            return _shown(_find(files(words[0]), words[1]) / over, words[4])
        if len(words) == 3:
            return _shown(_find(files(words[0]), words[1]), words[2])
    except (LookupError, TypeError, ValueError, ZeroDivisionError) as error:
        raise BadConfig(f"{{{{{place}}}}} cannot be filled: {type(error).__name__}: {error}") from error
    raise BadConfig(f"a place must be a file, a path and a format, or two paths with / between, found {{{{{place}}}}}")


def _find(content: Any, path: str) -> Any:
    at = 0
    while at < len(path):
        step = _STEP.match(path, at)
        if step is None:
            raise ValueError(f"{path!r} is no path from its character {at + 1} on")
        at = step.end()
        key, name, value = step.groups()
        if key is not None:
            content = content[int(key)] if isinstance(content, list) else content[key]
        else:
            found = [each for each in content if str(each[name]) == value]
            if not found:
                raise LookupError(f"no entry has {name} = {value}")
            content = found if "[" in path[at : at + 1] else found[0]
    return content


def _shown(value: Any, how: str) -> str:
    if how == "text":
        if not isinstance(value, str | int | float):
            raise TypeError(f"{value!r} is neither text nor a number")
        return str(value)
    percent, decimals = how.startswith("%"), int(how.lstrip("%."))
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{value!r} is no number")
    return f"{value * 100 if percent else value:,.{decimals}f}".replace(",", _THIN_SPACE)


def _read(file: Path) -> Any:
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise BadConfig(f"the page needs {file}, which is not there") from None
    except (OSError, ValueError) as error:
        raise BadConfig(f"{file} must be JSON: {error}") from error
