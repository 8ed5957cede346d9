"""Sources of bodies that installed packages add by an entry point."""

from __future__ import annotations

import textwrap
from pathlib import Path

import pytest
from small_rig import SMALL_FILE

from bodyseg_data import BadConfig, RangeImages, open_source
from bodyseg_data.bodies.sources import ENTRY_POINT
from bodyseg_data.commands import main

ADDED = """
    from dataclasses import replace
    from fakes import Figures

    class Dolls(Figures):
        name = "dolls"

        def check(self, body):
            pass

    class Scans(Dolls):
        name, reads = "scans", "one scan a person"

        def __init__(self, folder, landmarks, options):
            self.folder, self.units = folder, options.units

    class Faulty(Dolls):
        name, reads = "faulty", "nothing that is there"

        def __init__(self, folder, landmarks, options):
            self.fault = folder.name

        def bodies(self):
            found = super().bodies()
            if self.fault == "dotted":
                return [*found[:-1], replace(found[-1], subject="a.b")]
            return [] if self.fault == "empty" else found

        def check(self, body):
            if self.fault == "check":
                raise ValueError("two\\nlines")

        def build(self, body):
            if self.fault == "build":
                open(body.mesh)
            return super().build(body)

    class Half:
        name = "half"

        def bodies(self):
            return ()
"""


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with an installed package `dolls` that adds sources, sound ones and others."""
    (tmp_path / "dolls.py").write_text(textwrap.dedent(ADDED))
    info = tmp_path / "dolls-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: dolls\nVersion: 1.0\n")
    names = {"dolls": "Dolls", "scans": "Scans", "puppets": "Dolls", "half": "Half", "gone": "Gone", "faulty": "Faulty"}
    lines = [f"{name} = dolls:{kind}" for name, kind in names.items()]
    (info / "entry_points.txt").write_text("\n".join([f"[{ENTRY_POINT}]", *lines, "open = dolls:Dolls"]) + "\n")
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


@pytest.mark.usefixtures("packing_here")
def test_the_command_packs_a_source_of_another_package(installed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--views", "2", "--rig", str(SMALL_FILE), "--geodesics", "edges"]
    out = installed / "shards"
    assert main(["shard", "--source", "dolls", "--meshes", "2", "--out", str(out), *words]) == 0
    images = RangeImages(out, "all")
    assert len(images) == 4 and images.manifest.source == "dolls" and images.keys[0].startswith("dolls-")
    assert main(["verify", str(out)]) == 0
    assert main(["shard", "--source", "render", "--plan"]) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith("bodyseg shard: the source must be one of open, ")
    assert line.endswith(", paper, dolls, scans, puppets, half, gone, faulty, renders, rooms, found 'render'")


def test_a_source_may_read_a_folder(installed: Path) -> None:
    assert vars(open_source("scans", installed, units="mm")) == {"folder": installed, "units": "mm"}
    assert vars(open_source("scans", str(installed))) == {"folder": installed, "units": "auto"}
    assert type(open_source("open")).__module__ != "dolls"  # the names that ship stay what they are


@pytest.mark.usefixtures("packing_here")
@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("dotted", "source 'faulty': a sample key must be 1 to 80 letters, digits, '_', '+' or '-', found 'faulty-a"),
        ("empty", "the source 'faulty' has no bodies"),
        ("check", "the source 'faulty', body 'A-0': ValueError: two lines"),
        ("build", "the source 'faulty', body 'A-0': FileNotFoundError: [Errno 2] No such file or directory: 'A-0'"),
    ],
)
def test_faults_in_the_code_of_a_source_name_it_and_the_body(
    fault: str, message: str, installed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (installed / fault).mkdir()
    words = ["--path", str(installed / fault), "--views", "1", "--rig", str(SMALL_FILE), "--geodesics", "edges"]
    assert main(["shard", "--source", "faulty", "--out", str(installed / "shards"), *words]) == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith(f"bodyseg shard: {message}")


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize(
    ("name", "path", "units", "message"),
    [
        ("scans", None, "auto", "the source 'scans' needs --path: the folder that holds one scan a person"),
        ("dolls", Path(), "auto", "the source 'dolls' makes its bodies and reads no files: leave --path out"),
        ("dolls", None, "mm", "the source 'dolls' makes its bodies and reads no files: leave --units out"),
        ("puppets", None, "auto", "entry point puppets = 'dolls:Dolls' of bodyseg.sources: .* as its entry point"),
        ("half", None, "auto", "entry point half = .*: a source must be a class with the methods of BodySource"),
        ("gone", None, "auto", "entry point gone = 'dolls:Gone' of bodyseg.sources cannot be loaded: .*Gone"),
        ("cinema", None, "auto", "the source must be one of open, .*, paper, dolls, .*, gone, faulty, found 'cinema'"),
    ],
)
def test_what_is_wrong_with_a_source_is_one_line(name: str, path: Path | None, units: str, message: str) -> None:
    with pytest.raises(BadConfig, match=f"^{message}"):
        open_source(name, path, units=units)  # type: ignore[arg-type]
