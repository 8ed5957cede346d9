"""A page of results whose every number is read out of the JSON beside it, so that page and figures cannot part.

A template is Markdown with places like these:

    {{network.json networks.compact.cpu_ms .1}}         a number with one decimal
    {{compact.json average_per_class_accuracy %1}}      a share in per cent with one decimal
    {{loader.json bytes_per_sample.ours_all 0}}         a whole number, thousands apart
    {{network.json command text}}                       as it is
    {{network.json times[task=scores][threads=2].ms .1}}    of a list, the first entry that has these values
    {{loader.json samples_per_second.ours_all.2 / samples_per_second.memory.2 .2}}    one number over another
    {{stability.json tables.images table}}              a list of records, as a table with their names for a head
    {{motion.json tables.arithmetic[network=all] table}}    those of them that have this value
    {{failures.json sets.test.causes table cause share_of_wrong:%1}}    the same of some columns, in formats
    {{sources}}                                         a table of all files read: command, commit, hardware
"""

from __future__ import annotations

import json
import re
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

from bodyseg_data.core.errors import BadConfig

_PLACE: Final = re.compile(r"\{\{(.+?)\}\}")
_STEP: Final = re.compile(r"\.?([^.\[\]]+)|\[([^=\[\]]+)=([^\[\]]*)\]")
_SOURCES: Final = "sources"
_ORIGIN: Final = ("command", "commit", "hardware")


def render_page(template: str, folder: Path) -> str:
    """The template with every place filled from the JSON files of `folder`.

    Raises BadConfig, naming the place, for a file that is not there or no JSON, a value that it does not have, or one
    that does not fit its format.
    """
    files = lru_cache(maxsize=None)(lambda name: _read(folder / name))
    sources = sources_of(template)

    def fill(place: re.Match[str]) -> str:
        return _origins(sources, files) if place[1] == _SOURCES else _fill(place[1], files)

    return _PLACE.sub(fill, template)


def sources_of(template: str) -> list[str]:
    """The JSON files that a template reads, each once, in alphabetical order."""
    return sorted({place[1].split()[0] for place in _PLACE.finditer(template)} - {_SOURCES})


def _fill(place: str, files: Any) -> str:
    name, _, rest = place.strip().partition(" ")
    path, _, how = rest.strip().rpartition(" ")
    try:
        if " table " in rest:
            path, _, columns = rest.partition(" table ")
            return _columns(_find(files(name), path.strip()), columns.split())
        if " / " in path:
            value, over = (_find(files(name), each.strip()) for each in path.split(" / ", 1))
            return _shown(value / over, how)
        if path:
            return _shown(_find(files(name), path, every=how == "table"), how)
    except (LookupError, TypeError, ValueError, ZeroDivisionError) as error:
        raise BadConfig(f"{{{{{place}}}}} cannot be filled: {type(error).__name__}: {error}") from error
    raise BadConfig(f"a place must be a file, a path and a format, or two paths with / between, found {{{{{place}}}}}")


def _find(content: Any, path: str, every: bool = False) -> Any:
    """What stands at a path; every: all entries that its last condition holds for, not the first."""
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
            content = found if path[at : at + 1] == "[" or (every and at == len(path)) else found[0]
    return content


def _columns(records: Any, wanted: list[str]) -> str:
    """Some columns of records, each `name` or `name:format`; an empty cell where there is no value."""
    named = [(name, how or "text") for name, _, how in (each.partition(":") for each in wanted)]
    rows = [["" if row[name] is None else _shown(row[name], how) for name, how in named] for row in records]
    return _table([name.replace("_", " ") + (", %" if how[0] == "%" else "") for name, how in named], rows)


def _shown(value: Any, how: str) -> str:
    if how == "text":
        if not isinstance(value, str | int | float):
            raise TypeError(f"{value!r} is neither text nor a number")
        return str(value)
    if how == "table":
        return _table([*value[0]], [[str(cell) for cell in row.values()] for row in value])
    percent, decimals = how.startswith("%"), int(how.lstrip("%."))
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{value!r} is no number")
    return f"{value * 100 if percent else value:,.{decimals}f}".replace(",", " ")


def _origins(sources: list[str], files: Any) -> str:
    rows = []
    for name in sources:
        found = [files(name).get(what) for what in _ORIGIN]
        if not all(found):
            raise BadConfig(f"{name} must say its {', '.join(_ORIGIN)} to stand on the page, found {found}")
        rows.append([f"[{name}]({name})", f"`{found[0]}`", *map(str, found[1:])])
    return _table(["file", *_ORIGIN], rows)


def _table(head: list[str], rows: list[list[str]]) -> str:
    return "\n".join(f"| {' | '.join(row)} |" for row in [head, ["---"] * len(head), *rows])


def _read(file: Path) -> Any:
    try:
        return json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise BadConfig(f"the page needs {file}, which is not there") from None
    except (OSError, ValueError) as error:
        raise BadConfig(f"{file} must be JSON: {error}") from error
