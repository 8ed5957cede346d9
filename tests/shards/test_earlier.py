"""Sets of earlier formats, kept in tests/golden, are read for good, and hold what the example set holds."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from folders import GOLDEN

from bodyseg_data import RangeImages, example_set
from bodyseg_data.commands import main
from bodyseg_data.core import BadShard
from bodyseg_data.shards.earlier import piece_as_current

SETS = ("format_5", "format_5_png", "format_6")


@pytest.mark.parametrize("name", SETS)
def test_a_set_of_an_earlier_format_gives_the_samples_of_today(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    today, earlier = RangeImages(example_set(), "all"), RangeImages(GOLDEN / name, "all")
    assert earlier.manifest.classes == today.manifest.classes and earlier.manifest.read_as.startswith("bodyseg shards ")
    assert (earlier.manifest.index is not None) == (name == "format_6")
    for index, key in enumerate(earlier.keys):
        other = today.keys.index(key)
        assert earlier.clean(index).info == today.clean(other).info
        for ours, theirs in zip(earlier[index].items(), today[other].items(), strict=True):
            assert np.array_equal(np.asarray(ours[1]), np.asarray(theirs[1]))
    assert main(["verify", str(GOLDEN / name)]) == 0, capsys.readouterr()


@pytest.mark.parametrize("name", SETS)
def test_conditions_and_counts_know_an_earlier_set(name: str) -> None:
    everything = RangeImages(GOLDEN / name, "none")
    some = RangeImages(GOLDEN / name, "none", where=["pitch_deg=0", "azimuth_deg=0"])
    assert 0 < len(some) < len(everything) or len(everything) == len(some) == 2


def test_damage_of_an_earlier_index_is_one_line(tmp_path: Path) -> None:
    shutil.copytree(GOLDEN / "format_6", tmp_path / "set")
    data = bytearray((tmp_path / "set" / "samples.index").read_bytes())
    data[30] ^= 1
    (tmp_path / "set" / "samples.index").write_bytes(data)
    with pytest.raises(BadShard, match="altered: CRC-32"):
        _ = RangeImages(tmp_path / "set").keys
    for cut in range(0, len(data), 7):
        with pytest.raises(BadShard, match=f"^here: {cut} bytes are no piece of an index of format 6"):
            piece_as_current(bytes(data[:cut]), "here")
