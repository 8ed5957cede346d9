"""Sets of format 7 as they were first written, kept in tests/golden, are read for good; and with the same bits."""

from __future__ import annotations

import hashlib
import runpy

import numpy as np
import pytest
from folders import GOLDEN

from bodyseg_data import RangeImages
from bodyseg_data.commands import main

KEPT = {
    "format_5": "b1a62dbb9fda887e",
    "format_5_png": "1968809f67cf05b8",
    "format_6": "c76419b7d779a7df",
    "format_7": "374e35476b9d4348",
    "format_7_png": "9da47a9956030ce5",
}
"""Name -> the first digits of a digest of all files and their names."""

MADE = runpy.run_path(str(GOLDEN / "make_format_7.py"), run_name="make")


@pytest.mark.parametrize("name", KEPT)
def test_the_bytes_of_a_kept_set_are_those_that_were_written(name: str) -> None:
    digest = hashlib.sha256()
    for path in sorted((GOLDEN / name).iterdir()):
        digest.update(f"{path.name} {hashlib.sha256(path.read_bytes()).hexdigest()}\n".encode())
    assert digest.hexdigest()[:16] == KEPT[name], f"{name} was changed: sets of a format are written once"


@pytest.mark.parametrize("name", ["format_7", "format_7_png"])
def test_a_kept_set_of_format_7_gives_what_was_written(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    whole = name == "format_7"
    images = RangeImages(GOLDEN / name, "none", columns=("template", "weight"))
    manifest = images.manifest
    assert manifest.classes == MADE["CLASSES"] and manifest.rigs == MADE["RIGS"]
    assert (manifest.projector, manifest.read_as) == ("exact" if whole else "none", "bodyseg shards 7")
    for index, key in enumerate(images.keys):
        stored, made = images.clean(index), MADE["sample"](int(key[-3:]), "train", whole, whole)
        assert stored.info.fields == {**made.info.fields, "weight": index / 8}
        for field in ("range", "projector_range", "faces_projector"):
            assert np.array_equal(getattr(stored, field), getattr(made, field))
        assert np.array_equal(stored.labels, np.where(made.labels == 254, 255, made.labels))
        assert stored.planes.keys() == {*made.planes, "template"} and (stored.planes["template"] == 10 + index).all()
        assert all(np.array_equal(stored.planes[plane], made.planes[plane]) for plane in made.planes)
    assert [*images.table()["light"]] == [0, 0.25, 0.5, 0.75, 1, 1.25, 1.5, 1.75]
    assert main(["verify", str(GOLDEN / name)]) == 0, capsys.readouterr()
