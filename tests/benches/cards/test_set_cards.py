"""The Croissant file and the dataset card of a set, read by those who read such files."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benches.__main__ import main
from benches.cards.croissant import croissant
from benches.cards.dataset_cards import dataset_card, size_class
from benches.cards.facts import ORIGINS, Publication, SetFacts, origin_of, set_facts
from small_rig import SMALL

from bodyseg_data import ColumnWriter, RangeImages, ShardWriter
from bodyseg_data.bodies import SOURCES
from bodyseg_data.bodies.sources import source_class
from bodyseg_data.core import BadConfig
from bodyseg_data.labels import classes_of
from bodyseg_data.samples import ViewGrid
from bodyseg_data.shards import read_manifest
from bodyseg_data.shards.sample_codec import decode_sample
from bodyseg_data.transfer.transfers import CARD_NAMES

DAY = date(2026, 1, 31)
CROISSANT_NAME, CARD_NAME = CARD_NAMES

pytestmark = [
    # mlcroissant leaves files open, and rdflib, by which it parses, calls a class of its own that it calls deprecated.
    pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning:rdflib"),
    pytest.mark.filterwarnings("ignore:Python 3.14 will, by default, filter extracted tar archives:DeprecationWarning"),
]


@pytest.fixture(scope="module")
def mlcroissant(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """The package mlcroissant, which keeps what it unpacks in a folder of these tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CROISSANT_CACHE", str(tmp_path_factory.mktemp("croissant")))
        yield pytest.importorskip("mlcroissant")


@pytest.fixture(scope="module")
def described(small_set: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the small set, with cards."""
    folder = tmp_path_factory.mktemp("described") / "shards"
    shutil.copytree(small_set, folder)
    words = ["--title", "Plain figures", "--licence", "CC0-1.0", "--author", "A. Author", "--date", "2026-01-31"]
    assert main(["card", str(folder), *words]) == 0
    return folder


@pytest.fixture(scope="module")
def pictures(pack_figures: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set whose images are PNGs, without cards."""
    one_view = ViewGrid(span_deg=360, count=1)
    return pack_figures(tmp_path_factory.mktemp("pictures") / "pictures", codec="png", views=one_view)


@pytest.fixture(scope="module")
def facts(small_set: Path) -> SetFacts:
    return set_facts(read_manifest(small_set))


def records(mlcroissant: Any, folder: Path, name: str) -> dict[str, Any]:
    """Key -> content of all records of a record set."""
    dataset = mlcroissant.Dataset(folder / CROISSANT_NAME)
    found = [(record[f"{name}/key"].decode(), record[f"{name}/content"]) for record in dataset.records(name)]
    assert len(dict(found)) == len(found)
    return dict(found)


def test_a_croissant_file_is_valid_and_its_records_are_the_samples(mlcroissant: Any, described: Path) -> None:
    dataset = mlcroissant.Dataset(described / CROISSANT_NAME)
    assert dataset.metadata.ctx.conforms_to.value == "http://mlcommons.org/croissant/1.1"
    assert not dataset.metadata.ctx.issues.errors
    assert not dataset.metadata.ctx.issues.warnings
    assert [record["parts/label"] for record in dataset.records("parts")] == list(range(33))
    train = RangeImages(described, variant="none", split="train")
    assert sorted(records(mlcroissant, described, "train-bsi")) == sorted(train.clean(n).key for n in range(len(train)))
    images = RangeImages(described, variant="none", split="test")
    files, descriptions = (records(mlcroissant, described, f"test-{member}") for member in ("bsi", "json"))
    assert sorted(files) == sorted(descriptions) == sorted(images.clean(index).key for index in range(len(images)))
    for index in range(len(images)):
        image, clean = images[index], images.clean(index)
        read = decode_sample(clean.key, {"bsi": files[clean.key], "json": descriptions[clean.key]})
        range_m = read.range.astype(np.float32) * np.float32(images.step_m)
        assert np.array_equal(np.asarray(image["range"]).reshape(range_m.shape), range_m)
        assert np.array_equal(np.asarray(image["labels"]).reshape(range_m.shape), read.labels)
        assert read.info == clean.info


def test_records_of_a_set_of_png_are_images(mlcroissant: Any, pictures: Path, tmp_path: Path) -> None:
    folder = tmp_path / "shards"
    shutil.copytree(pictures, folder)
    assert main(["card", str(folder)]) == 0
    # The reader unpacks a shard into a folder named by the shard's address alone, so another set needs other names.
    tree = json.loads((folder / CROISSANT_NAME).read_text())
    for entry in tree["distribution"]:
        if "contentUrl" in entry:
            entry["contentUrl"] = f"../{folder.name}/{entry['contentUrl']}"
    (folder / CROISSANT_NAME).write_text(json.dumps(tree))
    images = RangeImages(folder, variant="none", split="test")
    ranges, labels = (records(mlcroissant, folder, f"test-{member}.png") for member in ("range", "labels"))
    assert len(ranges) == len(labels) == len(images)
    for index in range(len(images)):
        clean = images.clean(index)
        assert np.array_equal(np.asarray(ranges[clean.key]), clean.range)
        assert np.array_equal(np.asarray(labels[clean.key]), clean.labels)


def test_an_altered_shard_is_found_by_its_checksum(mlcroissant: Any, described: Path, tmp_path: Path) -> None:
    folder = tmp_path / "shards"
    shutil.copytree(described, folder)
    shard = folder / "test-00000.tar"
    data = bytearray(shard.read_bytes())
    data[700] ^= 1
    shard.write_bytes(data)
    with pytest.raises(Exception, match="generation of the dataset") as caught:
        records(mlcroissant, folder, "test-bsi")
    assert "Hash of downloaded file" in str(caught.value.__cause__)


def test_hugging_faces_datasets_stream_a_set(described: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    hub = pytest.importorskip("huggingface_hub.constants")
    monkeypatch.setattr(hub, "HF_HUB_OFFLINE", True)  # by the variable alone, it would stay so for other tests
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_HOME", str(tmp_path))
    datasets = pytest.importorskip("datasets")
    folder = tmp_path / "set"
    shutil.copytree(described, folder)
    with ColumnWriter(folder, "quality", "int") as column:  # its tars are no samples
        for key in RangeImages(folder, "none").keys:
            column.write(key, 1)
    of_card = re.findall(r"split: (.*)\n    path: (.*)\n", (folder / CARD_NAME).read_text())
    files = {split: str(folder / pattern) for split, pattern in of_card}
    samples = datasets.load_dataset("webdataset", data_files=files, streaming=True, cache_dir=str(tmp_path))
    for split in ("train", "test"):
        images = RangeImages(described, variant="none", split=split)
        count = 0
        for index, sample in enumerate(samples[split]):
            clean = images.clean(index)
            members = {"bsi": sample["bsi"], "json": json.dumps(sample["json"]).encode()}
            read = decode_sample(sample["__key__"], members)
            assert read.key == clean.key
            assert np.array_equal(read.range, clean.range)
            assert np.array_equal(read.labels, clean.labels)
            count += 1
        assert count == len(images)


def test_a_dataset_card_tells_what_the_manifest_holds(described: Path, facts: SetFacts) -> None:
    text = (described / CARD_NAME).read_text()
    _, header, page = text.split("---\n", 2)
    for line in ("license: cc0-1.0", 'pretty_name: "Plain figures"', "- n<1K", "    path: train-?????.tar"):
        assert f"{line}\n" in header
    assert f"bodyseg_manifest: {facts.manifest.digest}\n" in header
    for line in (
        "# Plain figures",
        "| train | 16 | 4 | 2 | A 8, people 8 | 2, 0.1 MB |",
        "| test | 8 | 2 | 2 | A 4, people 4 | 1, 0.0 MB |",
        "| camera | 160 x 82 pixels (rows x columns), focal length 189.394 pixels |",
        "| views | distance cm: 215 to 295; azimuth deg: 0 to 260 |",
        "| 32 | Lt. Digit II | tip of the second toe | left |",
        "- Every body is made; no person was measured.",
        "- this set: CC0-1.0, published by A. Author, 2026-01-31",
    ):
        assert f"{line}\n" in page


def test_a_card_promises_no_shadows_of_a_set_without_a_projector(facts: SetFacts) -> None:
    unlit = replace(facts, manifest=replace(facts.manifest, projector="none"))
    text = dataset_card(unlit, Publication("Unlit", DAY))
    assert "makes the variants none, noise, md of them" in text and 'variant="md", split="train"' in text


def test_a_users_own_fields_are_listed_whatever_their_names(tmp_path: Path) -> None:
    fields: Any = {"subject": "ann", "distance_cm": "far"}
    with ShardWriter(tmp_path / "set", rig=SMALL, classes=["box"], projector="none") as out:
        shape = SMALL.camera.rows, SMALL.camera.columns
        out.write(key="scene", range_m=np.full(shape, 2.0), labels=np.zeros(shape, int), fields=fields)
    found = set_facts(read_manifest(tmp_path / "set"))
    assert (found.fields, found.views) == ({"distance_cm": "far", "subject": "ann"}, {})


def test_names_of_classes_are_shown_as_they_are(facts: SetFacts) -> None:
    manifest = replace(facts.manifest, classes=classes_of(["<none>", "a*", "b*"]))
    page = dataset_card(replace(facts, manifest=manifest), Publication("Mine", DAY))
    assert "| 0 | &lt;none> |  | itself |\n| 1 | a\\* |  | itself |\n| 2 | b\\* |" in page
    assert "| rendered by | `" in page


def test_cards_state_what_no_manifest_knows_only_where_it_is_given(facts: SetFacts) -> None:
    plain = Publication("Mine", DAY)
    tree, page = croissant(facts, plain), dataset_card(facts, plain)
    assert not {"license", "url", "creator"} & set(tree)
    assert "license: unknown\n" in page
    assert "- this set: not stated, 2026-01-31\n" in page
    full = Publication("Mine", DAY, "The owner's terms, see there", "A. Author", "https://host/set/")
    tree, page = croissant(facts, full), dataset_card(facts, full)
    assert tree["license"] == "The owner's terms, see there"
    assert tree["distribution"][0]["contentUrl"] == f"https://host/set/{facts.manifest.shards[0].name}"
    assert 'license: other\nlicense_name: "The owner\'s terms, see there"\n' in page


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"title": " "}, "a card's title must be one line of text"),
        ({"licence": ""}, "a card's licence must be one line of text"),
        ({"author": "two\nlines"}, "a card's author must be one line of text"),
        ({"url": "s3://bucket/set"}, "a card's url must begin with https:// or http://"),
        ({"published": "2026"}, "Publication: published must be of class date"),
    ],
)
def test_a_publication_checks_its_facts(change: dict[str, Any], message: str) -> None:
    with pytest.raises(BadConfig, match=message):
        Publication(**{"title": "Mine", "published": DAY, **change})


def test_every_source_has_an_origin_and_only_made_bodies_are_nobodys(facts: SetFacts) -> None:
    assert set(ORIGINS) == set(SOURCES)
    assert {name for name in SOURCES if getattr(source_class(name), "reads", None) is None} == {
        name for name, origin in ORIGINS.items() if origin.made
    }
    assert not origin_of("somebody's own").made
    real = SetFacts(**{**vars(facts), "sources": ("paper", "mit"), "notes": ("a: repaired",)})
    page = dataset_card(real, Publication("Mine", DAY))
    assert "- Some bodies are those of real people; their shape may identify them.\n" in page
    assert "1 notes, listed by `bodyseg verify`." in page


def test_sizes_are_those_of_the_hub() -> None:
    assert [size_class(count) for count in (999, 1000, 125_766, 10**8)] == [
        "n<1K",
        "1K<n<10K",
        "100K<n<1M",
        "n>100M",
    ]


def test_a_page_that_is_there_stays(small_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = shutil.copytree(small_set, tmp_path / "shards")
    (folder / "README.md").write_text("# Of many hours\n")
    assert main(["card", str(folder)]) == 2
    assert f"written already, perhaps by hand: {folder / 'README.md'}: delete" in capsys.readouterr().err
    assert (folder / "README.md").read_text() == "# Of many hours\n" and not (folder / "croissant.json").exists()
    (folder / "README.md").unlink()
    for _ in range(2):  # the same bytes again
        assert main(["card", str(folder), "--date", "2026-01-31"]) == 0
    assert main(["card", str(folder), "--date", "2026-02-01"]) == 2
    assert "croissant.json, " in (said := capsys.readouterr().err) and "README.md: delete" in said, "all in one line"


def test_bad_arguments_of_card_get_one_line(
    described: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for words, message in (
        ([str(described), "--date", "soon"], "--date must be a day like 2026-01-31, found 'soon'"),
        ([str(tmp_path)], "neither a set of shards nor a trained network"),
        ([str(tmp_path / "absent.safetensors")], "neither a set of shards nor a trained network"),
    ):
        assert main(["card", *words]) == 2
        said = capsys.readouterr().err
        assert message in said
        assert said.count("\n") == 1
