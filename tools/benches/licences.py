"""`tools/licences`: licences of the packages that an installation brings, extra by extra.

Packages name what they need and their licence in their metadata; the versions are those installed.
"""

from __future__ import annotations

import functools
import re
import sys
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from email.message import Message
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any, Final

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from bodyseg_data.commands import option
from bodyseg_data.core import BadConfig

EXAMPLE = "tools/licences render fast"

PROJECT: Final = Path(__file__).parents[2] / "pyproject.toml"

STREAMING: Final = "streaming"
"""Name of an installation without extras."""

_APPROVED: Final = "License :: OSI Approved :: "

_PHRASES: Final = {
    "Apache-2.0": "Apache License Version 2.0",
    "MIT": "Permission is hereby granted, free of charge",
    "BSD": "Redistribution and use in source and binary forms",
    "GPL": "GNU GENERAL PUBLIC LICENSE",
}
"""Name of a licence -> words of its text."""

_LICENCE_FILE: Final = re.compile(r"[^/]+\.dist-info/(.+/)?(LICEN[CS]E|COPYING)[^/]*,")
"""A line of what was installed."""

_FAMILIES: Final = {
    "Apache": r"Apache",
    "BSD": r"BSD",
    "GPL": r"\bGPL|GNU General Public|GNU GENERAL PUBLIC",
    "LGPL": r"LGPL|Lesser General",
    "MIT": r"\bMIT\b",
    "MPL": r"MPL|Mozilla",
    "PSF": r"PSF|Python Software",
}


@dataclass(frozen=True)
class Options:
    """Options of the command."""

    extras: tuple[str, ...] = option("extras to list (default: all, and what every installation has)", (), True)


@dataclass(frozen=True)
class Licensed:
    """A package that is installed, and the licence that its metadata names."""

    name: str
    version: str
    licence: str


def run(options: Options) -> int:
    """Print a table for each extra, of what it adds to an installation without extras. Raises BadConfig."""
    known = extras()
    for wanted in options.extras:
        if wanted not in known:
            raise BadConfig(f"the extra must be one of {', '.join(known)}, found {wanted!r}")
    base = {package.name for package in brought(STREAMING)}
    for extra in options.extras or known:
        rows = [package for package in brought(extra) if extra == STREAMING or package.name not in base]
        title = "pip install bodyseg" if extra == STREAMING else f"pip install 'bodyseg[{extra}]'"
        sys.stdout.write(f"\n## {title}\n\n| package | version | licence |\n| --- | --- | --- |\n")
        sys.stdout.write("".join(f"| {row.name} | {row.version} | {row.licence} |\n" for row in rows))
    return 0


def extras() -> tuple[str, ...]:
    """List the extras of the project, after `STREAMING`."""
    return STREAMING, *_project()["optional-dependencies"]


def brought(extra: str) -> list[Licensed]:
    """List the packages that an extra, or `STREAMING`, installs on this machine, sorted by name.

    Packages that its metadata name but that are not installed have the version and licence "not installed".
    """
    project = _project()
    wanted = [] if extra == STREAMING else project["optional-dependencies"][extra]
    found: dict[str, Licensed] = {}
    seen: set[tuple[str, str]] = set()
    queue = [Requirement(text) for text in (*project["dependencies"], *wanted)]
    while queue:
        need = queue.pop()
        name = canonicalize_name(need.name)
        for of in ("", *need.extras):
            if (name, of) in seen:
                continue
            seen.add((name, of))
            if name == project["name"]:
                queue += map(Requirement, project["optional-dependencies"].get(of, ()))
                continue
            needs, found[name] = _installed(need.name)
            queue += [each for each in needs if each.marker is None or each.marker.evaluate({"extra": of})]
    return [found[name] for name in sorted(found)]


def licence_of(metadata: Message, text: str = "") -> str:
    """Return the licence that a package's metadata name: an SPDX expression, else classifiers, else its name; "unknown"
    without any.

    text: of the package's licence file, "" without one. It decides where the metadata name no licence, and is named
    beside them where they name another.
    """
    stated = str(metadata.get("License") or "").strip()
    classifiers = [str(line) for line in metadata.get_all("Classifier", [])]
    approved = ", ".join(line.removeprefix(_APPROVED) for line in classifiers if line.startswith(_APPROVED))
    named = str(metadata.get("License-Expression") or approved or ("" if "\n" in stated else stated))
    read = next((name for name, phrase in _PHRASES.items() if phrase in " ".join((text or stated).split())), "")
    if not named or not read or families(named) & families(read):
        return named or read or "unknown"
    return f"{named} (its licence file: {read})"


def families(licence: str) -> set[str]:
    """Return the kinds of licence that a text names, of Apache, BSD, GPL, LGPL, MIT, MPL and PSF."""
    return {name for name, pattern in _FAMILIES.items() if re.search(pattern, licence)}


@functools.cache
def _installed(name: str) -> tuple[Sequence[Requirement], Licensed]:
    try:
        found = distribution(name)
    except PackageNotFoundError:
        return (), Licensed(name, "not installed", "not installed")
    metadata: Any = found.metadata
    listed = (found.read_text("RECORD") or "").splitlines()  # `files` makes an object of each of thousands
    files = sorted(line.partition(",")[0] for line in listed if _LICENCE_FILE.match(line))
    text = Path(str(found.locate_file(files[0]))).read_text(encoding="utf-8") if files else ""
    needs = [Requirement(each) for each in found.requires or ()]
    return needs, Licensed(metadata["Name"], metadata["Version"], licence_of(metadata, text))


def _project() -> dict[str, Any]:
    return dict(tomllib.loads(PROJECT.read_text())["project"])
