"""CAESAR's .lnd files: cut, misspelt, missing and doubled names, and never one landmark taken for another."""

from __future__ import annotations

import gzip
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from bodyseg_data.core import BadLandmarks
from bodyseg_data.labels import LANDMARKS
from bodyseg_data.meshes import load_landmark_file
from bodyseg_data.meshes.landmarks import read_lnd, recognise

OTHERS = (
    "Infraorbitale", "Tragion", "Gonion", "Clavicale", "10th Rib", "Iliocristale", "Axilla, Ant.", "Ulnar Styloid",
    "Radiale", "Humeral Lateral Epicn", "Humeral Medial Epicn", "Metacarpal Phal. II", "Metacarpal Phal. V",
    "Femoral Medial Epicn", "Metatarsal Phal. I", "Metatarsal Phal. V", "Medial Malleolus", "Sphyrion",
    "Calcaneous, Post.",
)  # fmt: skip
SURVEY = (
    *LANDMARKS,
    "Waist, Preferred, Post.",
    "Crotch",
    *(f"{side} {name}" for name in OTHERS for side in ("Rt.", "Lt.")),
)
"""All 73 landmarks of the survey."""

POINTS = {name: (10.0 * label, -3.5, 100.25 + label) for label, name in enumerate(SURVEY)}


def rows(**changes: str | None) -> list[str]:
    """A row for each of the 73; `changes` gives other rows for some, or None for none."""
    lines = []
    for number, (name, point) in enumerate(POINTS.items(), 1):
        row = f"{number:4d} -3 0.0 1  {point[0]:10.2f} {point[1]:10.2f} {point[2]:10.2f} {name}"
        changed = changes.get(name, row)
        if changed is not None:
            lines.append(changed)
    return lines


def text(lines: list[str], newline: str = "\r\n") -> str:
    head = ["TYPE = 1", "1 2 3 4 5 6 7 Sellion", "AUX ="]
    return newline.join([*head, *lines, "END =", "1 -3 0.0 1 9 9 9 Sellion", ""])


def write(folder: Path, content: str, name: str = "csr0001a.lnd") -> Path:
    path = folder / name
    path.write_bytes(content.encode("latin-1"))
    return path


def expected() -> np.ndarray:
    return np.array([POINTS[name] for name in LANDMARKS]) / 1000


def test_a_whole_file_is_read_in_metres_in_the_order_of_parts(tmp_path: Path) -> None:
    path = write(tmp_path, text(rows()))
    found = read_lnd(path)
    assert found.source == str(path)
    np.testing.assert_allclose(found.points, expected(), rtol=0, atol=1e-12)


def test_a_gzipped_file_is_read_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "csr0001a.lnd.gz"
    path.write_bytes(gzip.compress(text(rows()).encode("latin-1")))
    np.testing.assert_allclose(load_landmark_file(path).points, expected(), atol=1e-12)  # type: ignore[union-attr]


def test_rows_need_no_leading_numbers_and_may_have_many(tmp_path: Path) -> None:
    bare = {name: f"{x} {y} {z}   {name}  " for name, (x, y, z) in POINTS.items()}
    some = {**bare, "10th Rib Midspine": "7 7 7 7 7 7 " + bare["10th Rib Midspine"]}
    np.testing.assert_allclose(read_lnd(write(tmp_path, text(rows(**some), "\n"))).points, expected(), atol=1e-12)


CUT_OR_MISSPELT = {
    "Rt. Acromio": "Rt. Acromion",
    "Cervical": "Cervicale",
    "Lt. Femoral Lateral Epicn ": "Lt. Femoral Lateral Epicn",
    "Rt. Femoral Lateral Epicn #Rt. Femoral Medial Epicn": "Rt. Femoral Lateral Epicn",
    "Rt. Thelion/Bustpoin": "Rt. Thelion/Bustpoint",
    "Rt. Thelion / Bustpoint": "Rt. Thelion/Bustpoint",
    "Rt. Axilla, Post": "Rt. Axilla, Post.",
    "Rt. Knee Creas": "Rt. Knee Crease",
    "LT  OLECRANNON": "Lt. Olecranon",
    "Rt Radial Styl": "Rt. Radial Styloid",
    "Lt. Latral Malleolus": "Lt. Lateral Malleolus",
    "10TH RIB  MIDSPINE": "10th Rib Midspine",
    "Right Digit II": "Rt. Digit II",
    "Rt. Digit": "Rt. Digit II",
    "Selion": "Sellion",
    "Rt._PSIS": "Rt. PSIS",
}


@pytest.mark.parametrize(("written", "meant"), CUT_OR_MISSPELT.items())
def test_a_cut_or_misspelt_name_is_recognised(written: str, meant: str) -> None:
    assert recognise(written) == meant


@pytest.mark.parametrize(
    "written",
    [
        "Femoral Lateral Epicn",  # whose?
        "Rt. Metacarpal-Phal. V",
        "Lt. Axilla, An",
        "Lt. Medial Malleolu",
        "Rt. Sellion",
        "Clavicale",
        "Rt. Cervicale",
        "Rt. Femoral",
        "Lt. Axilla",
        "Rt. Radial",
        "Rt. Metatarsal-Phal.",
        "Lt. A",
        "Lt. SIS",
        "Rt. Digit I",
        "Rt. Digit V",
        "Rt. Digit III",
        "9th Rib Midspine",
        "10th Rib",
        "Rt. 10th",
        "Supra",
        "AUX LAND",
        "Butt Block",
        "Lt.",
        "#Rt. PSIS",
        "",
    ],
)
def test_what_could_be_another_is_not_guessed(written: str) -> None:
    assert recognise(written) is None


@pytest.mark.parametrize("name", SURVEY)
def test_every_slip_of_one_letter_is_recognised_as_itself_or_not_at_all(name: str) -> None:
    assert recognise(name) == (name if name in LANDMARKS else None)
    for place in range(len(name)):
        for slip in (name[:place] + name[place + 1 :], name[:place] + "x" + name[place + 1 :]):
            if slip[:2].lower() == name[:2].lower():  # the side as it was
                assert recognise(slip) in ({name, None} if name in LANDMARKS else {None}), slip


@pytest.mark.parametrize("name", SURVEY)
def test_every_cut_name_is_recognised_as_itself_or_not_at_all(name: str) -> None:
    for length in range(len(name)):
        assert recognise(name[:length]) in ({name, None} if name in LANDMARKS else {None}), name[:length]


def test_cut_names_are_enough_for_a_whole_body(tmp_path: Path) -> None:
    changes = {
        name: row.rstrip() for name, row in zip(POINTS, (line[:-1] for line in rows()), strict=True) if len(name) > 12
    }
    short = {name: row for name, row in changes.items() if not name.endswith((" II", " V", " I"))}
    np.testing.assert_allclose(read_lnd(write(tmp_path, text(rows(**short)))).points, expected(), atol=1e-12)


@pytest.mark.parametrize(
    "row",
    [
        None,
        "1 -3 0 1 -999 -999 -999 Nuchale",
        "1 -3 0 1 0.0 0 0 Nuchale",
        "1 -3 0 1 nan nan nan Nuchale",
        "3 4 Nuchale",
    ],
)
def test_a_missing_landmark_is_named(tmp_path: Path, row: str | None) -> None:
    path = write(tmp_path, text([*rows(Nuchale=row), "1 -3 0 1 5 5 5 Nacken"]))
    with pytest.raises(BadLandmarks, match="'Nuchale' missing$") as caught:
        read_lnd(path)
    assert str(path) in str(caught.value)
    assert "Sellion" not in str(caught.value)


def test_a_packed_file_is_told_by_its_name_in_any_case_and_may_not_grow_without_end(tmp_path: Path) -> None:
    path = tmp_path / "CSR0001A.LND.GZ"
    path.write_bytes(gzip.compress(text(rows()).encode("latin-1")))
    np.testing.assert_allclose(read_lnd(path).points, expected(), atol=1e-12)
    path.write_bytes(gzip.compress(bytes(64 << 20)))
    tracemalloc.start()
    try:
        with pytest.raises(BadLandmarks, match=r"CSR0001A\.LND\.GZ: a \.lnd file may hold 1 MiB, found more"):
            read_lnd(path)
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()


def test_a_landmark_given_twice_must_be_in_one_place(tmp_path: Path) -> None:
    again = next(row for row in rows() if row.endswith(" Nuchale"))
    placeholder = "1 -3 0 1 -999 -999 -999 Nuchale"
    np.testing.assert_allclose(read_lnd(write(tmp_path, text([*rows(), again, placeholder]))).points, expected())
    elsewhere = "1 -3 0 1 5 5 5 Nuchal"
    with pytest.raises(BadLandmarks, match=r"line 77: 'Nuchale' is given twice, .* and \(5.0, 5.0, 5.0\)"):
        read_lnd(write(tmp_path, text([*rows(), elsewhere])))


def test_other_landmarks_may_be_missing_or_doubled(tmp_path: Path) -> None:
    lines = [*rows(Crotch=None), "1 -3 0 1 5 5 5 Rt. Tragion", "stray", ""]
    np.testing.assert_allclose(read_lnd(write(tmp_path, text(lines))).points, expected())


@pytest.mark.parametrize(("gone", "lacking"), [("AUX =", "AUX ="), ("END =", "END ="), ("\r\n", "AUX =")])
def test_a_file_without_its_frame_is_refused(tmp_path: Path, gone: str, lacking: str) -> None:
    path = write(tmp_path, text(rows()).replace(gone, " "))
    with pytest.raises(BadLandmarks, match=f"'AUX =' and 'END =', found no '{lacking}'"):
        read_lnd(path)


def test_a_file_that_cannot_be_read_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadLandmarks, match=r"cannot read .*absent\.lnd"):
        read_lnd(tmp_path / "absent.lnd")
    for content in (b"not gzip", gzip.compress(text(rows()).encode())[:-20]):
        path = tmp_path / "cut.lnd.gz"
        path.write_bytes(content)
        with pytest.raises(BadLandmarks, match=r"cut\.lnd\.gz is not a whole gzip file"):
            read_lnd(path)


def test_a_name_without_end_takes_no_time_without_end(tmp_path: Path) -> None:
    assert recognise("Rt. " + "Acromion" * 100_000) is None
