"""Sensor models: any artifacts in any order, in Python, TOML and JSON, and artifacts of other packages."""

from __future__ import annotations

import copy
import json
import pickle
import textwrap
from dataclasses import FrozenInstanceError, dataclass
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bodyseg_data import RangeImages, SensorModel, load_sensor_model, loader
from bodyseg_data.artifacts import (
    Artifact,
    Losses,
    MissingData,
    Noise,
    Occlusion,
    RangeImage,
    Scene,
    artifact_class,
    artifacts_to_json,
    parse_artifacts,
    sensor_for,
    sensor_model_names,
)
from bodyseg_data.artifacts.registry import ENTRY_POINT
from bodyseg_data.artifacts.sensor_model import parse_sensor_model, sensor_model_from_json
from bodyseg_data.core import BadConfig, Draws
from bodyseg_data.labels import BACKGROUND, UNLABELLED

PAPER = load_sensor_model("paper")
REVERSED = SensorModel("reversed", (Losses(0.4), MissingData((0.25,)), Noise(5.0, 5.0), Occlusion()), "another order")


@dataclass(frozen=True)
class Rounding(Artifact):
    """Ranges rounded to whole centimetres: an artifact of a user's own."""

    name, kind = "rounding", "noise"
    version = 3

    step_mm: float = 10.0

    def apply(self, image: RangeImage, scene: Scene, draws: Draws) -> None:
        """As `Artifact.apply`."""
        steps = self.step_mm / 1000 / scene.step_m
        image.range[...] = np.rint(image.range / steps) * steps


@dataclass(frozen=True)
class Faulty(Artifact):
    """An artifact that fails on some images."""

    name, kind, purposes = "faulty", "noise", ("fault",)
    share: float = 0.3

    def apply(self, image: RangeImage, scene: Scene, draws: Draws) -> None:
        """As `Artifact.apply`."""
        if draws.chance("fault") < self.share:
            raise IndexError("two\nlines")


def test_the_default_is_the_papers() -> None:
    assert PAPER == load_sensor_model() == load_sensor_model(PAPER)
    assert list(PAPER) == [Occlusion(), Noise(0.0, 100.0), MissingData((0.0, 0.05, 0.5))] and len(PAPER) == 3
    assert PAPER.with_artifacts(Noise(1.0, 2.0)).artifacts[1] == Noise(1.0, 2.0)
    assert repr(SensorModel("mine", (Noise(1.0, 2.0),))) == "SensorModel('mine', Noise(low_mm=1.0, high_mm=2.0))"
    assert repr(SensorModel("ideal")) == "SensorModel('ideal', no artifacts)"
    assert artifacts_to_json(PAPER.artifacts) == [
        {"artifact": "occlusion", "version": 1},
        {"artifact": "noise", "version": 1, "low_mm": 0.0, "high_mm": 100.0},
        {"artifact": "missing_data", "version": 1, "rates": [0.0, 0.05, 0.5], "between": None},
    ], "cards of trained networks hold this"


def test_a_model_is_a_value() -> None:
    strong = PAPER.with_artifacts(Losses(0.4))
    assert pickle.loads(pickle.dumps(strong)) == copy.deepcopy(strong) == strong
    assert strong != PAPER and hash(strong) != hash(PAPER)
    with pytest.raises(FrozenInstanceError):
        strong.name = "weak"  # type: ignore[misc]
    assert SensorModel("mine", [Noise()]).artifacts == (Noise(),)  # type: ignore[arg-type]


def test_artifacts_are_replaced_where_they_stand_and_new_ones_come_last() -> None:
    assert [each.name for each in PAPER.with_artifacts(Losses(0.4), Noise(0, 50))] == [
        "occlusion",
        "noise",
        "missing_data",
        "losses",
    ]
    assert list(PAPER.without("noise", "occlusion")) == [MissingData()]
    assert PAPER.with_artifacts() == PAPER == PAPER.with_artifacts(Noise()).without()
    with pytest.raises(BadConfig, match="sensor paper has no 'losses': its artifacts are occlusion, noise, missing"):
        PAPER.without("losses")
    with pytest.raises(BadConfig, match="an artifact may be given once, found noise twice"):
        PAPER.with_artifacts(Noise(), Noise(1.0))
    name: Any = "noise"
    for way in (lambda: PAPER.with_artifacts(name), lambda: sensor_for("all", PAPER, [name])):
        with pytest.raises(BadConfig, match="sensor paper: an artifact must be a dataclass derived from Artifact"):
            way()


@pytest.mark.parametrize(
    ("name", "artifacts", "message"),
    [
        ("two words", (), "a sensor's name must be one plain word of at most 40 letters, found 'two words'"),
        (7, (), "a sensor's name must be one plain word of at most 40 letters, found 7"),
        ("mine", Noise(), "sensor mine: artifacts must be a tuple of them, found Noise"),
        ("mine", (0.4,), "sensor mine: an artifact must be a dataclass derived from Artifact, found float"),
        (
            "mine",
            (Noise,),
            "sensor mine: an artifact must be a dataclass derived from Artifact, found a class: call it",
        ),
        (
            "mine",
            (Noise(), Noise(1.0)),
            "sensor mine: names of artifacts must differ, found 'noise' of noise and noise",
        ),
    ],
)
def test_other_objects_are_refused(name: Any, artifacts: Any, message: str) -> None:
    with pytest.raises(BadConfig) as refused:
        SensorModel(name, artifacts)
    assert str(refused.value) == message


def test_an_artifact_must_be_frozen_and_of_a_kind_with_strengths_in_json() -> None:
    @dataclass
    class Thawed(Artifact):
        name, kind = "thawed", "noise"

    @dataclass(frozen=True)
    class Strange(Artifact):
        name = "strange"
        kind = "dust"  # type: ignore[assignment]

    @dataclass(frozen=True)
    class Filed(Artifact):
        name, kind = "filed", "noise"
        table: Path = Path("table.npy")

    @dataclass(frozen=True)
    class Uniform(Noise):
        """Noise of another distribution, by the same name."""

    for make in (lambda: SensorModel("mine", (Uniform(),)), lambda: PAPER.with_artifacts(Uniform())):
        with pytest.raises(BadConfig, match=r"sensor \w+: 'noise' is the name of another artifact, found Uniform"):
            make()
    with pytest.raises(BadConfig, match="title and strengths must be plain JSON: Object of type PosixPath is not"):
        SensorModel("mine", (Filed(),))
    with pytest.raises(BadConfig, match="an artifact must be a frozen dataclass, found Thawed"):
        SensorModel("mine", (Thawed(),))
    with pytest.raises(BadConfig, match="one kind of occlusion, noise, missing_data, found Strange"):
        SensorModel("mine", (Strange(),))


@pytest.mark.parametrize(
    "sensor",
    [
        PAPER,
        REVERSED,
        SensorModel("ideal"),
        PAPER.with_artifacts(MissingData((1.0,))),
        SensorModel("titled", title='Tiefenkamera für "Bühne\\ 😀" \t\x7f'),
    ],
)
def test_what_is_written_as_toml_or_json_is_read_again(sensor: SensorModel, tmp_path: Path) -> None:
    text = sensor.to_toml({"": "a\nb", "noise": "measured"})
    assert parse_sensor_model(text, "x") == sensor
    assert ("# measured\n[[artifacts]]" in text) == ("noise" in [each.name for each in sensor])
    (tmp_path / "sensor.toml").write_text(text, encoding="ascii")  # and so from 'sensor show' in any locale
    assert load_sensor_model(tmp_path / "sensor.toml") == load_sensor_model(str(tmp_path / "sensor.toml")) == sensor
    assert (
        parse_sensor_model(sensor.to_toml(), "x").to_json()
        == sensor.to_json()
        == json.loads(json.dumps(sensor.to_json()))
    )


def test_every_shipped_sensor_can_be_read_and_streams(figures_set: Path) -> None:
    assert "paper" in sensor_model_names()
    for name in sensor_model_names():
        sensor = load_sensor_model(name)
        assert sensor.name == name and sensor.title
        images = RangeImages(figures_set, sensor=name)
        assert images.augmentation.sensor == sensor
        assert images[0]["range"].any()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("=", "sensor x is not TOML: "),
        ("name = 'a'", "sensor x: 'format' must be 'bodyseg sensor 1'"),
        ("format = 'bodyseg sensor 1'", "sensor x: text 'name' is missing"),
        ("format = 'bodyseg sensor 1'\nname = 'a'\nnoise = 3", "sensor x: unknown 'noise'"),
        ("format = 'bodyseg sensor 1'\nname = 'a'\nartifacts = 3", r"sensor x: 'artifacts' must be tables \[\[art"),
        ("format = 'bodyseg sensor 1'\nname = 'a b'", "sensor x: a sensor's name must be one plain word"),
        (2 * "[[artifacts]]\nartifact = 'noise'\n", "sensor x: sensor a: names of artifacts must differ"),
        ("[[artifacts]]\nlow_mm = 3", r"sensor x: \[\[artifacts\]\] must name its 'artifact', found None"),
        ("[[artifacts]]\nartifact = 'dust'", "sensor x: an artifact must be one of occlusion, .*, found 'dust'"),
        ("[[artifacts]]\nartifact = 'noise'\nsigma = 3", "sensor x: a strength of noise must be .*, found 'sigma'"),
        ("[[artifacts]]\nartifact = 'noise'\nlow_mm = -3", "sensor x: Noise: low_mm must be from 0 to 1000, found -3"),
        ("[[artifacts]]\nartifact = 'noise'\nversion = 9", "sensor x: noise is of version 9, installed is version 1"),
    ],
)
def test_a_bad_sensor_file_is_one_line(text: str, message: str) -> None:
    if text.startswith("[["):
        text = f"format = 'bodyseg sensor 1'\nname = 'a'\n{text}"
    with pytest.raises(BadConfig, match=f"^{message}") as refused:
        parse_sensor_model(text, "x")
    assert "\n" not in str(refused.value)


def test_a_sensor_that_is_not_there_is_one_line(tmp_path: Path, figures_set: Path) -> None:
    with pytest.raises(BadConfig, match="no sensor is called 'kinect': give one of .*paper.* or the path of a .toml"):
        RangeImages(figures_set, sensor="kinect")
    with pytest.raises(BadConfig, match=r"cannot read the sensor file .*none\.toml: "):
        load_sensor_model(tmp_path / "none.toml")
    with pytest.raises(BadConfig, match="a sensor is given by its name or a path, found 3$"):
        load_sensor_model(3)  # type: ignore[arg-type]


def test_a_strength_that_toml_cannot_hold_is_refused() -> None:
    @dataclass(frozen=True)
    class Wide(Artifact):
        name, kind = "wide", "noise"
        limit: float = float("inf")

    with pytest.raises(BadConfig, match="a sensor file holds text, numbers, flags and lists of them, found inf"):
        SensorModel("mine", (Wide(),)).to_toml()


def test_an_artifact_of_the_users_own_streams_and_is_in_the_identity(figures_set: Path) -> None:
    sensor = SensorModel("mine", (Rounding(), Losses(0.2)))
    images, clean = RangeImages(figures_set, "noise", sensor=sensor), RangeImages(figures_set, "none", sensor=sensor)
    assert images.identity()["artifacts"] == [
        {"artifact": "rounding", "version": 3, "step_mm": 10.0},
        {"artifact": "losses", "version": 2, "most": 0.2},
    ]
    for index in range(3):
        made, before = images.image(index).range, clean.image(index).range
        whole = round(0.01 / images.step_m)
        assert (made % whole == 0).all() and np.abs(made.astype(int) - before).max() == whole // 2
    with pytest.raises(BadConfig, match="sensor x: an artifact must be one of occlusion, .*, found 'rounding'"):
        parse_sensor_model(sensor.to_toml(), "x")


@pytest.mark.parametrize("options", [{}, {"num_workers": 2}, {"on_error": "skip", "skip_budget": 24}])
def test_an_error_in_an_artifact_names_it_and_the_sample_and_ends_no_loop_in_silence(
    figures_set: Path, options: dict[str, Any]
) -> None:
    images = RangeImages(figures_set, "noise", sensor=SensorModel("mine", (Faulty(),)))
    first = next(key for key in images.keys if Draws(0, 0, key).chance("fault") < Faulty.share)
    assert first != images.keys[0]
    for read in (lambda: [image["key"] for image in images], lambda: list(loader(images, 4, shuffle=False, **options))):
        with pytest.raises(BadConfig) as caught:
            read()
        assert str(caught.value) == f"{first}: artifact 'faulty': IndexError: two lines"
        assert 'raise IndexError("two\\nlines")' in "".join(caught.value.__notes__), "the traceback is kept"


def test_an_error_in_an_artifacts_draw_names_it(figures_set: Path) -> None:
    class Undrawn(Faulty):
        def draw(self, draws: Draws) -> dict[str, float]:
            raise KeyError("sigma")

    with pytest.raises(BadConfig, match=": artifact 'faulty': KeyError: 'sigma'"):
        RangeImages(figures_set, "noise", sensor=SensorModel("mine", (Undrawn(),)))[0]


def test_an_artifact_may_give_a_pixel_another_class_of_the_set_alone(figures_set: Path) -> None:
    @dataclass(frozen=True)
    class Named(Artifact):
        name, kind = "named", "noise"
        label: int = 32

        def apply(self, image: RangeImage, scene: Scene, draws: Draws) -> None:
            """As `Artifact.apply`."""
            image.labels[image.range > 0] = self.label

    def images(label: int) -> RangeImages:
        return RangeImages(figures_set, "noise", sensor=SensorModel("mine", (Named(label),)))

    for label in (32, UNLABELLED, BACKGROUND):
        assert set(images(label)[0]["labels"].unique().tolist()) == {label, BACKGROUND}
    with pytest.raises(BadConfig, match="artifact 'named' must give labels 0 to 32, 254 or 255, found 33$"):
        images(33)[0]


def test_what_an_artifact_draws_without_listing_it_replaces_no_quantity_of_another(figures_set: Path) -> None:
    @dataclass(frozen=True)
    class Greedy(Artifact):
        name, kind = "greedy", "noise"

        def draw(self, draws: Draws) -> dict[str, float]:
            return {"sigma_mm": 0.0}

    images = RangeImages(figures_set, "noise", sensor=SensorModel("mine", (Noise(), Greedy())))
    with pytest.raises(BadConfig, match="artifact 'greedy' must list what it draws in 'drawn', found 'sigma_mm'"):
        images[0]


def test_the_order_is_the_models(figures_set: Path) -> None:
    """Rounding before noise leaves noise; after it, whole centimetres."""
    first = RangeImages(figures_set, "noise", sensor=SensorModel("a", (Rounding(), Noise(30.0, 30.0)))).image(0)
    last = RangeImages(figures_set, "noise", sensor=SensorModel("b", (Noise(30.0, 30.0), Rounding()))).image(0)
    whole = round(0.01 / RangeImages(figures_set).step_m)
    assert (last.range % whole == 0).all() and (first.range % whole != 0).mean() > 0.1
    plain = RangeImages(figures_set, "noise", sensor=SensorModel("c", (Noise(30.0, 30.0),))).image(0)
    np.testing.assert_array_equal(np.rint(plain.range / whole) * whole, last.range)


ADDED = """
    from dataclasses import dataclass
    from bodyseg_data.artifacts.artifact import Artifact

    @dataclass(frozen=True)
    class Haze(Artifact):
        name, kind = "haze", "noise"
        away_mm: float = 3.0

        def apply(self, image, scene, draws):
            image.range[image.range > 0] += round(self.away_mm / 1000 / scene.step_m)

    class Nothing:
        pass
"""


def _install(folder: Path, entries: str) -> None:
    """Lay out an installed package `weather` with entry points of artifacts."""
    (folder / "weather.py").write_text(textwrap.dedent(ADDED))
    info = folder / "weather-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: weather\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{ENTRY_POINT}]\n{entries}\n")


def test_an_installed_package_adds_artifacts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, figures_set: Path
) -> None:
    _install(
        tmp_path,
        "haze = weather:Haze\nfog = weather:Haze\nrain = weather:Nothing\nsnow = weather:Snow\ngone = climate:Gone",
    )
    monkeypatch.syspath_prepend(tmp_path)
    assert artifact_class("haze").__module__ == "weather"
    sensor = parse_sensor_model(
        'format = "bodyseg sensor 1"\nname = "a"\n[[artifacts]]\nartifact = "haze"\naway_mm = 5', "x"
    )
    assert artifacts_to_json(sensor.artifacts) == [{"artifact": "haze", "version": 1, "away_mm": 5}]
    images = RangeImages(figures_set, sensor=sensor)
    hazy, clean = images.image(0), images.clean(0)
    away = np.uint16(round(0.005 / images.step_m))
    np.testing.assert_array_equal(hazy.range, np.where(clean.range > 0, clean.range + away, 0))
    for name, message in (
        ("fog", r"entry point fog = 'weather:Haze' of bodyseg.artifacts: the artifact must be called .*, found 'haze'"),
        ("rain", "entry point rain = .*: an artifact must be a dataclass derived from Artifact, found Nothing"),
        ("snow", "entry point snow = 'weather:Snow' of bodyseg.artifacts cannot be loaded: .*Snow"),
        ("gone", "entry point gone = .* cannot be loaded: No module named 'climate'"),
        ("hail", "an artifact must be one of occlusion, .*, haze, .*, found 'hail'"),
    ):
        with pytest.raises(BadConfig, match=f"^{message}"):
            artifact_class(name)


def test_strengths_left_out_are_the_sensors() -> None:
    assert parse_artifacts('{"noise": {"high_mm": 50}}', "x", PAPER) == (Noise(0.0, 50),)
    assert parse_artifacts('{"noise": {"high_mm": 50}}', "x", REVERSED) == (Noise(5.0, 50),)
    assert parse_artifacts("{}", "x", PAPER) == ()
    assert parse_artifacts('{"losses": {}, "occlusion": {}}', "x", PAPER) == (Losses(), Occlusion())
    assert parse_artifacts('{"losses": {}}', "x", REVERSED) == (Losses(0.4),)
    for first, second in permutations((MissingData(rates=(0.2,)), MissingData(between=(0.1, 0.5)))):
        fitted = SensorModel("fitted", (first,))
        assert parse_artifacts('{"missing_data": {}}', "x", fitted) == (first,)
        (strength,) = (name for name in MissingData.either if getattr(second, name) != getattr(MissingData, name))
        given = {"missing_data": {strength: getattr(second, strength)}}
        assert parse_artifacts(json.dumps(given), "x", fitted) == (second,)  # which replaces the sensor's other one
        assert sensor_model_from_json(fitted.to_json(), "x") == fitted


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nonsense", "--artifacts must be JSON, found 'nonsense': Expecting value"),
        ("[" * 100_000, "--artifacts must be JSON"),
        ("[1]", r'--artifacts must be strengths by artifact, like \{"noise": \{"high_mm": 50\}\}, found \[1\]'),
        ('{"noise": 50}', "--artifacts must be strengths by artifact, .*, found {'noise': 50}"),
        ('{"dust": {}}', "--artifacts: an artifact must be one of occlusion, .*, found 'dust'"),
        ('{"noise": {"sigma": 50}}', "--artifacts: a strength of noise must be one of low_mm, high_mm, found 'sigma'"),
        ('{"occlusion": {"gap": 5}}', "--artifacts: a strength of occlusion must be one of none, found 'gap'"),
        ('{"noise": {"high_mm": -5}}', "--artifacts: Noise: high_mm must be from 0 to 1000, found -5"),
        ('{"noise": {"high_mm": NaN}}', "--artifacts: Noise: high_mm must be from 0 to 1000, found nan"),
        ('{"noise": {"high_mm": "50"}}', "--artifacts: Noise: high_mm must be a number, found '50'"),
        ('{"missing_data": {"rates": 0.5}}', "--artifacts: MissingData: rates must be a tuple, .* found 0.5"),
        (
            '{"missing_data": {"rates": [0.2], "between": [0, 1]}}',
            r"--artifacts: missing data takes rates or between, not both, found \(0.2,\) and \(0.0, 1.0\)",
        ),
        ('{"missing_data": {"between": [1]}}', r"--artifacts: MissingData: between must be a tuple .* found \[1\]"),
    ],
)
def test_json_that_is_no_artifacts_is_one_line(text: str, message: str) -> None:
    with pytest.raises(BadConfig, match=f"^{message}") as refused:
        parse_artifacts(text, "--artifacts", PAPER)
    assert "\n" not in str(refused.value)


def test_a_strength_that_the_variant_has_no_use_for_is_refused() -> None:
    assert sensor_for("all", PAPER, [Noise(0, 50), Losses(0.1)]) == PAPER.with_artifacts(Noise(0, 50), Losses(0.1))
    assert sensor_for("none", PAPER, []) == PAPER
    for variant, artifact, kind in (
        ("none", Noise(), "noise"),
        ("occ+md", Noise(), "noise"),
        ("noise", Losses(0.1), "missing_data"),
        ("noise+md", Occlusion(), "occlusion"),
    ):
        message = f"a strength of {artifact.name} is for a variant that has {kind}, found variant '{variant}'"
        with pytest.raises(BadConfig, match=message.replace("+", r"\+")):
            sensor_for(variant, PAPER, [artifact])
    with pytest.raises(BadConfig, match="the variant must be one of"):
        sensor_for("full", PAPER, [Noise()])
