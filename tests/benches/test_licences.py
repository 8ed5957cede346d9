"""`tools/licences`: what each extra installs, under which licence, and that documents say the same."""

from __future__ import annotations

import re
import tomllib
from email.message import Message
from functools import cache

import pytest
from benches import licences
from benches.__main__ import main
from benches.licences import STREAMING, extras, families, licence_of
from folders import DOCS, ROOT

brought = cache(licences.brought)
"""What is installed stays as it is: each extra is followed once."""

TEXT = "Copyright (c) 2020\n\nRedistribution and use in source\nand binary forms, with or without modification"


def described(**fields: str) -> Message:
    metadata = Message()
    for name, value in fields.items():
        metadata[name.replace("_", "-")] = value
    return metadata


@pytest.mark.parametrize(
    ("fields", "text", "licence"),
    [
        ({"License_Expression": "MIT", "License": "see LICENSE"}, "", "MIT"),
        ({"Classifier": "License :: OSI Approved :: BSD License", "License": "new BSD"}, TEXT, "BSD License"),
        ({"License": "GPL3"}, "", "GPL3"),
        ({"License": TEXT}, "", "BSD"),
        ({}, TEXT, "BSD"),
        ({"License": "MIT"}, TEXT, "MIT (its licence file: BSD)"),
        ({}, "All rights reserved", "unknown"),
    ],
)
def test_a_licence_is_read(fields: dict[str, str], text: str, licence: str) -> None:
    assert licence_of(described(**fields), text) == licence


def test_families() -> None:
    assert families("LGPL-3.0-or-later") == {"LGPL"}
    assert families("BSD License, GNU General Public License (GPL)") == {"BSD", "GPL"}
    assert families("MPL-2.0 AND MIT") == {"MPL", "MIT"}
    assert families("Permitted") == set()


def test_extras_bring_what_their_packages_need() -> None:
    assert {"torch", "sympy", "numpy"} <= {package.name for package in brought(STREAMING)}
    assert "numba" not in {package.name for package in brought(STREAMING)}
    assert {"numba", "llvmlite", "trimesh", "anny"} <= {package.name for package in brought("render")}


@pytest.mark.parametrize("page", ["tutorials/your_camera.md", "tutorials/your_renders.md"])
def test_a_tutorial_installs_what_its_figures_need(page: str) -> None:
    text = (DOCS / page).read_text()
    (given,) = re.findall(r"^pip install 'bodyseg\[(.+)\]'", text, re.MULTILINE)
    assert "--figures" in text
    assert "matplotlib" in {package.name for extra in given.split(",") for package in brought(extra)}


def test_gpl_code_comes_with_one_extra_alone() -> None:
    """docutils, which builds documents, has a choice of licences."""
    found = {
        extra: {package.name for package in brought(extra) if "GPL" in families(package.licence)} - {"docutils"}
        for extra in extras()
    }
    assert {extra for extra, names in found.items() if names} <= {"pymeshlab", "dev"}
    assert found["pymeshlab"] <= {"pymeshlab"}


def test_documents_name_the_licences_of_what_is_installed() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lines = (ROOT / "docs" / "reference" / "dependencies.md").read_text().splitlines()
    needed = [
        *project["dependencies"],
        *(name for extra in project["optional-dependencies"].values() for name in extra),
    ]
    names = {re.split(r"[^\w-]", text)[0].lower() for text in needed} - {"bodyseg"}
    licence_by_name = {package.name.lower(): package.licence for package in brought("dev")}
    wrong = []
    for name in sorted(names):
        said = [line.split("|")[2] for line in lines if re.match(rf"\| [^|]*`{name}`", line, re.IGNORECASE)]
        installed = licence_by_name[name]
        if installed in ("unknown", "not installed"):
            continue
        if not said or not families(said[0]) & families(installed):
            wrong.append(f"{name}: {installed}, documented as {said}")
    assert not wrong


def test_the_command_prints_a_table(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["licences", "fast"]) == 0
    printed = capsys.readouterr().out
    assert "pip install 'bodyseg[fast]'" in printed and re.search(r"^\| numba \| .* BSD", printed, re.MULTILINE)
    assert "torch" not in printed
    assert main(["licences", STREAMING]) == 0
    assert re.search(r"^\| torch \|", capsys.readouterr().out, re.MULTILINE)


def test_an_unknown_extra_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["licences", "gold"]) == 2
    assert "the extra must be one of streaming, fast, segment, render, " in capsys.readouterr().err
