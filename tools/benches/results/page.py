"""The page of results: a Jinja2 template whose every number is read out of the JSON beside it.

A variable is a JSON file of the folder without its `.json`, so page and figures cannot part:

    {{ network.networks.compact.cpu_ms | number(1) }}           a number with one decimal, thousands apart
    {{ compact.average_per_class_accuracy | percent(1) }}       a share in per cent with one decimal
    {{ network.command }}                                       text as it is
    {{ (network.times | find(task="scores", threads=2)).ms | number }}      the first record that has these values
    {{ stability.tables.images | table }}                       records as a table, with their names for a head
    {{ charts.left_out[0] }}                                    what `tools/chart` writes into charts.json
    {{ processors | each("loader", "ours_all_over", "mds_raw", "2") | span(1) }}        least and most over processors
    {{ sources }}                                               a table of all files read: command, commit, hardware
    {{ outdated }}                                              a paragraph on files that the code of today did not make

Files of `bodyseg stability` have their numbers as `tables` of text as well.

`processors` has a record of each folder of `processors/`: its `name`, and its files' contents by their names without
`.json`. `each` takes the value at a path of names from all records that have the path's first name.

All else is Jinja2's own: `a / b`, `| length`, `{% for %}`. A number without a format is refused.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from traceback import extract_tb
from typing import Any, Final

from jinja2 import Environment, StrictUndefined, TemplateError, TemplateSyntaxError, Undefined, meta

from benches.charts.processors import FOLDER, HEAD, by_processor
from benches.charts.scales import thousands
from benches.charts.stability_tables import FORMAT, tables
from benches.results.outdated import outdated, stale_results
from bodyseg_data.core import BadConfig
from bodyseg_data.files import read_json

_SOURCES: Final = "sources"
_OUTDATED: Final = "outdated"
_SPECIAL: Final = {_SOURCES, _OUTDATED, FOLDER}  # variables that are no file
_TEMPLATE: Final = "<template>"  # the name that Jinja2 gives to one from a string
_ORIGIN: Final = ("command", "commit", "hardware")


def render_page(template: str, folder: Path, values: Mapping[str, Any] | None = None) -> str:
    """The template, filled from the JSON files of `folder` and from `values`: further variables by name.

    Raises BadConfig, with the line of the template, for what is no Jinja2, a file that is not there or no JSON, a value
    that it does not have, or one that does not fit its format.
    """
    given = dict(values or {})
    names = _variables(template)
    files = {name: _with_tables(read_json(folder / f"{name}.json")) for name in sorted(names - _SPECIAL - {*given})}
    processors = by_processor(folder) if FOLDER in names else []
    given[FOLDER] = processors
    read = files | {
        f"{FOLDER}/{one['folder']}/{name}": content
        for one in processors
        for name, content in one.items()
        if name not in HEAD
    }
    sources = {_SOURCES: _origins(read)} if _SOURCES in names else {}
    if _OUTDATED in names and _OUTDATED not in given:
        sources[_OUTDATED] = outdated(stale_results(folder), [f"{name}.json" for name in read])
    try:
        return _environment().from_string(template).render(files | given | sources)
    except (TemplateError, AttributeError, LookupError, TypeError, ValueError, ZeroDivisionError) as error:
        raise BadConfig(f"line {_line(error)} of the template cannot be filled: {error}") from error


def sources_of(template: str) -> list[str]:
    """The JSON files that a template reads, each once, in alphabetical order. Raises BadConfig if it is no template."""
    return [f"{name}.json" for name in sorted(_variables(template) - _SPECIAL)]


def _with_tables(content: Any) -> Any:
    """The content of a file; that of `bodyseg stability` with its numbers as `tables` of text as well."""
    return content | {"tables": tables(content)} if content.get("format") == FORMAT else content


def _variables(template: str) -> set[str]:
    try:
        return meta.find_undeclared_variables(_environment().parse(template))
    except TemplateSyntaxError as error:
        raise BadConfig(f"line {error.lineno} of the template is no Jinja2: {error.message}") from error


def _environment() -> Environment:
    environment = Environment(
        undefined=StrictUndefined, finalize=_finished, trim_blocks=True, keep_trailing_newline=True, autoescape=False
    )
    environment.globals.clear()  # a file may be called as one of them
    environment.filters |= {"number": _number, "percent": _percent, "find": _find, "table": _table, "gross": _gross}
    environment.filters |= {"each": _each, "span": _span}
    return environment


def _finished(value: Any) -> Any:
    """Let text through; what is undefined raises when it is written."""
    if isinstance(value, str | Undefined):
        return value
    raise TypeError(f"{value!r} is no text and has no format")


def _number(value: Any, decimals: int = 0) -> str:
    return thousands(_checked(value), decimals)


def _percent(value: Any, decimals: int = 0) -> str:
    return _number(_checked(value) * 100, decimals)


def _gross(scores: Mapping[str, Any], decimals: int = 1) -> str:
    """Gross errors of scores, in words: beyond 30 mm, beyond 60 mm, mean distance."""
    found = scores.get("gross_errors")
    if found is None:
        return "not measured"
    shares = " and ".join(f"{_percent(found[f'beyond_{mm}_mm'], decimals)} % beyond {mm} mm" for mm in (30, 60))
    return f"{shares}, {_number(found['mean_mm'], decimals)} mm on average"


def _checked(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{value} is no number")  # writing an undefined value raises its own message
    return value


def _find(records: Iterable[Mapping[str, Any]], **values: Any) -> Mapping[str, Any]:
    for record in records:
        if all(record.get(name) == value for name, value in values.items()):
            return record
    raise LookupError(f"no entry has {', '.join(f'{name} = {value}' for name, value in values.items())}")


def _each(records: Iterable[Mapping[str, Any]], first: str, *keys: str) -> list[Any]:
    found = []
    for record in records:
        if (value := record.get(first)) is not None:
            for key in keys:
                value = value[key]
            found.append(value)
    return found


def _span(values: Iterable[Any], decimals: int = 0) -> str:
    shown = [_number(value, decimals) for value in sorted(map(_checked, values))]
    if not shown:
        raise LookupError("a span needs a number")
    return shown[0] if shown[0] == shown[-1] else f"{shown[0]} to {shown[-1]}"


def _table(records: Iterable[Mapping[str, Any]]) -> str:
    rows = [*records]
    if not rows:
        raise LookupError("a table needs an entry")
    head = [*rows[0]]
    lines = [head, ["---"] * len(head), *([str(cell) for cell in row.values()] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _origins(files: Mapping[str, Any]) -> str:
    rows = []
    for name, content in files.items():
        found = [content.get(what) for what in _ORIGIN]
        if not all(found):
            raise BadConfig(f"{name}.json must say its {', '.join(_ORIGIN)} to stand on the page, found {found}")
        origin = dict(zip(_ORIGIN, found, strict=True))
        rows.append({"file": f"[{name}.json]({name}.json)", **origin, "load before · after": _loads(content)})
    return _table(row | {"command": f"`{row['command']}`"} for row in rows)


def _loads(content: Mapping[str, Any]) -> str:
    """Load of the machine before and after a bench, as far as it was recorded."""
    loads = [content.get(f"load_{when}") for when in ("before", "after")]
    return "–" if loads == [None, None] else " · ".join("–" if each is None else _number(each, 2) for each in loads)


def _line(error: Exception) -> int:
    """Line of the template that failed: Jinja2 puts its lines into the traceback."""
    return next(step.lineno or 0 for step in reversed(extract_tb(error.__traceback__)) if step.filename == _TEMPLATE)
