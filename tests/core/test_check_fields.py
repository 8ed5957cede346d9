"""Settings that a user builds, given values of the wrong type: one line of the family's errors, never a traceback."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import pytest
import torch

from bodyseg_data import RangeImages
from bodyseg_data.artifacts import Augmentation, Noise, SensorModel, load_sensor_model
from bodyseg_data.artifacts.registry import ARTIFACTS
from bodyseg_data.core import BadConfig, BadShard, Checked, bounded, check_choice, check_fields
from bodyseg_data.packing import Packing
from bodyseg_data.rigs import Distortion, load_rig
from bodyseg_data.samples import View, ViewGrid
from bodyseg_data.samples.views import Drawn
from bodyseg_data.shards import RetryPolicy
from bodyseg_model import Background, FrameLabeller, Segmenter, evaluate, frame_camera, predict, train, wrapped
from bodyseg_model.networks.compact import CompactSettings
from bodyseg_model.training import GeometricAugmentation
from bodyseg_model.training.recipes import PRESETS

_RIG: Final = load_rig()
BUILT: Final = [
    *(kind() for kind in ARTIFACTS.values()),
    load_sensor_model(),
    _RIG,
    _RIG.camera,
    Distortion(),
    ViewGrid(),
    Drawn(0, 1),
    View(255, 20),
    Packing("open"),
    Augmentation(_RIG, "all"),
    RetryPolicy(),
    CompactSettings(),
    GeometricAugmentation(),
    PRESETS["compact"],
]
FIELDS: Final = [(built, field.name) for built in BUILT for field in fields(built)]  # type: ignore[arg-type]


@pytest.mark.parametrize(("built", "name"), FIELDS, ids=[f"{type(built).__name__}.{name}" for built, name in FIELDS])
def test_a_value_of_the_wrong_type_is_one_line(built: Any, name: str) -> None:
    before = getattr(built, name)
    refused = 0
    for wrong in (None, "a", ("x",), {}, object(), float("nan"), 1.5, -1):
        try:
            made = getattr(replace(built, **{name: wrong}), name)
        except BadConfig as error:
            assert str(error).isprintable() and "object at" not in str(error).replace("<object object at", "")
            refused += 1
        else:
            optional = before is None or isinstance(wrong, type(None) | type(before))
            assert optional or isinstance(wrong, float | int), f"{name} takes {wrong!r}: {made!r}"
    assert refused >= 3


def test_the_message_names_class_field_rule_and_value() -> None:
    with pytest.raises(BadConfig, match=r"^Noise: low_mm must be a number, found 'a'$"):
        Noise("a", "b")  # type: ignore[arg-type]
    with pytest.raises(BadConfig, match=r"^Packing: path must be of class Path or None, found 'meshes'$"):
        Packing("folder", path="meshes")  # type: ignore[arg-type]
    with pytest.raises(BadConfig, match=r"^sensor a: artifacts must be a tuple of them, found NoneType$"):
        SensorModel("a", None)  # type: ignore[arg-type]
    with pytest.raises(BadConfig, match=r"^sensor a: the title must be text, found 3$"):
        SensorModel("a", title=3)  # type: ignore[arg-type]
    with pytest.raises(BadConfig, match=r"^sensor a: title and strengths must be plain JSON: .*surrogates"):
        SensorModel("a", title="half \ud800 of a pair, which a file would not give back")


@dataclass(frozen=True)
class Every:
    """One field of each kind that settings have."""

    number: float = 1.0
    whole: int = 1
    switch: bool = True
    text: str = "a"
    choice: Literal["a", 2] = "a"
    either: Path | None = None
    many: tuple[int, ...] = ()
    pair: tuple[float, str] = (1.0, "a")
    anything: Any = None

    def __post_init__(self) -> None:
        check_fields(self)


@pytest.mark.parametrize(
    ("name", "wrong", "words"),
    [
        ("number", True, "a number, found True"),
        ("number", "1", "a number, found '1'"),
        ("whole", 1.0, "a whole number, found 1.0"),
        ("switch", 1, "True or False, found 1"),
        ("text", b"a", "text, found b'a'"),
        ("choice", "b", "'a' or 2, found 'b'"),
        ("choice", [], r"'a' or 2, found \[\]"),
        ("either", "a", "of class Path or None, found 'a'"),
        ("many", 1, "a tuple, each entry a whole number, found 1"),
        ("many", (1, "a"), r"a tuple, each entry a whole number, found \(1, 'a'\)"),
        ("pair", (1.0,), r"a tuple of a number and text, found \(1.0,\)"),
        ("pair", ("a", 1.0), r"a tuple of a number and text, found \('a', 1.0\)"),
    ],
)
def test_every_kind_of_field_is_checked(name: str, wrong: Any, words: str) -> None:
    with pytest.raises(BadConfig, match=f"^Every: {name} must be {words}$"):
        Every(**{name: wrong})


def test_numbers_of_numpy_whole_floats_and_lists_are_accepted() -> None:
    made = Every(np.float32(1), np.int64(2), many=[1, 2], pair=[1, "a"], anything=object())  # type: ignore[arg-type]
    assert made.whole == 2 and Every(number=3, choice=2).number == 3


def test_fields_hold_numbers_and_tuples_of_python_which_are_stored_alike() -> None:
    made = Every(np.float32(1), np.int64(2), many=np.arange(3).tolist(), pair=[np.int64(1), "a"])  # type: ignore[arg-type]
    assert repr(made) == repr(Every(1.0, 2, many=(0, 1, 2), pair=(1.0, "a")))
    assert Every(10**400).number == 10**400  # which bounds refuse
    with pytest.raises(BadConfig, match="^Noise: high_mm must be "):
        Noise(0.0, 10**400)
    assert json.dumps(asdict(made)) and hash(made) == hash(Every(1, 2, many=(0, 1, 2), pair=(1, "a")))


@dataclass(frozen=True)
class Bounded:
    open_below: float = bounded(1.0, 0, 10, above=True)
    closed: int = bounded(1, 1, 50)
    each: tuple[float, ...] = bounded((0.0, 1.0), 0, 1)
    optional: float | None = bounded(None, 0, 1)

    def __post_init__(self) -> None:
        check_fields(self)


@pytest.mark.parametrize(
    ("name", "wrong", "words"),
    [
        ("open_below", 0.0, "above 0 and at most 10, found 0.0"),
        ("closed", 51, "from 1 to 50, found 51"),
        ("each", (0.5, 1.5), r"from 0 to 1, found \(0.5, 1.5\)"),
        ("optional", float("nan"), "from 0 to 1, found nan"),
    ],
)
def test_numbers_beyond_the_bounds_of_a_field_are_refused(name: str, wrong: Any, words: str) -> None:
    with pytest.raises(BadConfig, match=f"^Bounded: {name} must be {words}$"):
        Bounded(**{name: wrong})
    assert Bounded(10.0, 50, (), 1.0)


def test_a_choice_is_one_of_the_names_that_the_message_lists() -> None:
    assert check_choice("the day", "mon", ("mon", "tue")) == "mon"
    for wrong in ("sun", None, ["mon"]):
        with pytest.raises(BadConfig, match="^the day must be one of mon, tue, found "):
            check_choice("the day", wrong, {"mon": 1, "tue": 2})
    with pytest.raises(BadShard, match="^the day must be one of none, found 'mon'$"):
        check_choice("the day", "mon", (), BadShard)


@dataclass(frozen=True)
class Window(Checked):
    low: float | None = None
    high: float | None = bounded(None, 0, 10, not_below="low")


def test_a_number_may_not_be_below_that_of_another_field() -> None:
    assert Window(1, 1) != Window(None, 3)
    assert Window() == Window(None, None)
    for low, high in ((2.0, 1.0), (2.0, None)):
        with pytest.raises(BadConfig, match=f"^Window: low must be at most high, found {low} and {high}$"):
            Window(low, high)
    with pytest.raises(BadConfig, match="^Window: high must be from 0 to 10, found 11$"):
        Window(12, 11)


class Doubled(torch.nn.Module):
    def forward(self, range_m: torch.Tensor) -> torch.Tensor:
        return range_m.repeat(1, 2, 1, 1)


def test_arguments_of_the_public_functions_say_what_they_must_be(figures_set: Path, tmp_path: Path) -> None:
    images, out = RangeImages(figures_set, "none", "train"), tmp_path / "run"
    trained, mine = wrapped(Doubled(), ["floor", "wall"]), frame_camera((60, 80), "mine", focal_px=100.0)
    network, camera, values = trained.network, mine.camera, np.ones((1, 1, 2, 2), np.float32)
    stream = FrameLabeller(trained, Background("keep")).stream
    calls: list[tuple[str, Any, tuple[Any, ...], dict[str, Any]]] = [
        ("label_map must be of class LabelMap, found 'limbs14'", evaluate, (network, images), {"label_map": "limbs14"}),
        ("range images must be of class Tensor, found ", predict, (network, values), {}),
        ("rig must be of class Rig or None, found 'paper'", wrapped, (Doubled(), ["a", "b"]), {"rig": "paper"}),
        ("the network must be of a class in NETWORKS, .*Trained", train, (images, out, trained), {}),
        ("recipe must be of class Recipe or None, found 'finder'", train, (images, out), {"recipe": "finder"}),
        ("validation must be of class Validation or None, found Ra", train, (images, out), {"validation": images}),
        ("run_options must be of class RunOptions or None, found 2", train, (images, out), {"run_options": 2}),
        ("camera must be of class Camera, found FrameCamera", Segmenter, (network, mine), {}),
        ("background must be of class Background or None, found 'keep'", Segmenter, (network, camera, "keep"), {}),
        ("rig must be of class Rig or None, found 'paper'", Segmenter, (network, camera), {"rig": "paper"}),
        ("label_map must be of class LabelMap, found 1", Segmenter, (network, camera), {"label_map": 1}),
        ("video must be of class CarriedLabels or None, found True", Segmenter, (network, camera), {"video": True}),
        ("background must be of class Background, found 'keep'", FrameLabeller, (trained, "keep"), {}),
        ("a frame needs its camera, like .*, found FrameCamera", lambda *given: next(stream(*given)), ([], mine), {}),
    ]
    for message, function, given, named in calls:
        with pytest.raises(BadConfig, match=f"^{message}"):
            function(*given, **named)
    assert not out.exists()
