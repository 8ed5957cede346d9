"""The strengths of all artifacts together: given by class or name, told apart, read from JSON and written to it."""

from __future__ import annotations

import copy
import json
import pickle
from dataclasses import FrozenInstanceError
from typing import Any

import pytest

from bodyseg_data import Artifacts
from bodyseg_data.artifacts.losses import Losses
from bodyseg_data.artifacts.missing_data import MissingData
from bodyseg_data.artifacts.noise import Noise
from bodyseg_data.artifacts.occlusion import Occlusion
from bodyseg_data.artifacts.strengths import artifacts_from_json, parse_artifacts
from bodyseg_data.artifacts.variants import artifacts_for
from bodyseg_data.core.errors import BadConfig

PAPER = {"noise": {"low_mm": 0.0, "high_mm": 100.0}, "missing_data": {"rates": [0.0, 0.05, 0.5], "between": None}}


def test_the_defaults_are_the_papers() -> None:
    usual = Artifacts()
    assert list(usual) == [Occlusion(), Noise(0.0, 100.0), MissingData((0.0, 0.05, 0.5))]
    assert usual.noise == Noise() and usual.losses is None
    assert usual.to_json() == PAPER, "cards of trained networks hold this"
    assert repr(Artifacts(noise=Noise(1.0, 2.0))) == (
        "Artifacts(occlusion=Occlusion(), noise=Noise(low_mm=1.0, high_mm=2.0), "
        "missing_data=MissingData(rates=(0.0, 0.05, 0.5), between=None), losses=None)"
    )


def test_artifacts_are_given_by_class_or_by_name() -> None:
    strong = Artifacts(noise=Noise(0, 50), losses=Losses(0.4))
    assert strong == Artifacts(Losses(0.4), Noise(0, 50)) == Artifacts(Noise(0, 50), losses=Losses(0.4))
    assert [artifact.name for artifact in strong] == ["occlusion", "noise", "missing_data", "losses"]
    assert strong != Artifacts() and hash(strong) != hash(Artifacts())
    assert strong.to_json() == {**PAPER, "noise": {"low_mm": 0, "high_mm": 50}, "losses": {"most": 0.4}}
    assert Artifacts(losses=None) == Artifacts()
    without = Artifacts(noise=None)
    assert without.noise is None and list(without) == [Occlusion(), MissingData()]
    assert without.to_json().keys() == {"missing_data"}


def test_they_are_values() -> None:
    strong = Artifacts(losses=Losses(0.4))
    assert pickle.loads(pickle.dumps(strong)) == copy.deepcopy(strong) == strong
    with pytest.raises(FrozenInstanceError):
        strong.noise = Noise()
    with pytest.raises(AttributeError, match="'Artifacts' object has no attribute 'dust'"):
        _ = strong.dust
    assert not hasattr(strong, "_other")


@pytest.mark.parametrize(
    ("given", "named", "message"),
    [
        ((), {"dust": Noise()}, "an artifact must be one of occlusion, noise, missing_data, losses, found 'dust'"),
        ((), {"noise": Losses(0.1)}, "noise must be of class Noise, found Losses"),
        ((), {"noise": {"high_mm": 5}}, "noise must be of class Noise, found dict"),
        ((Noise(),), {"noise": Noise()}, "an artifact may be given once, found noise twice"),
        ((Noise(), Noise(1.0)), {}, "an artifact may be given once, found noise twice"),
        ((0.4,), {}, "an artifact must be an object of a registered class, found float"),
        ((None,), {}, "an artifact must be an object of a registered class, found NoneType"),
    ],
)
def test_other_objects_are_refused(given: Any, named: dict[str, Any], message: str) -> None:
    with pytest.raises(BadConfig, match=f"^{message}$"):
        Artifacts(*given, **named)


@pytest.mark.parametrize(
    "artifacts",
    [
        Artifacts(),
        Artifacts(Noise(1, 2.5), MissingData(between=(0.1, 0.2)), Losses(0.3)),
        Artifacts(MissingData((0.25,))),
    ],
)
def test_what_is_written_as_json_is_read_again(artifacts: Artifacts) -> None:
    tree = artifacts.to_json()
    assert Artifacts(*artifacts_from_json(tree, "a card")) == artifacts
    assert parse_artifacts(json.dumps(tree), "--artifacts") == artifacts_from_json(tree, "--artifacts")


def test_strengths_left_out_are_the_papers() -> None:
    assert parse_artifacts('{"noise": {"high_mm": 50}}', "x") == (Noise(0.0, 50),)
    assert parse_artifacts("{}", "x") == ()
    assert parse_artifacts('{"losses": {}, "occlusion": {}}', "x") == (Losses(), Occlusion())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("nonsense", "--artifacts must be JSON, found 'nonsense': Expecting value"),
        ("[" * 100_000, "--artifacts must be JSON"),
        ("[1]", r'--artifacts must be strengths by artifact, like \{"noise": \{"high_mm": 50\}\}, found \[1\]'),
        ('{"noise": 50}', "--artifacts must be strengths by artifact, .*, found {'noise': 50}"),
        ('{"dust": {}}', "an artifact must be one of occlusion, .*, found 'dust'"),
        ('{"noise": {"sigma": 50}}', "--artifacts: a strength of noise must be one of low_mm, high_mm, found 'sigma'"),
        ('{"occlusion": {"gap": 5}}', "--artifacts: a strength of occlusion must be one of none, found 'gap'"),
        (
            '{"noise": {"high_mm": -5}}',
            "--artifacts: noise must satisfy 0 <= low <= high <= 1000 mm, found low 0.0 and",
        ),
        ('{"noise": {"high_mm": NaN}}', "--artifacts: noise must satisfy"),
        ('{"noise": {"high_mm": "50"}}', "--artifacts: strengths of noise must be of the right types, found .*'50'"),
        ('{"missing_data": {"rates": 0.5}}', "--artifacts: strengths of missing_data must be of the right types"),
        ('{"missing_data": {"between": [1]}}', "--artifacts: strengths of missing_data must be of the right types"),
    ],
)
def test_json_that_is_no_artifacts_is_one_line(text: str, message: str) -> None:
    with pytest.raises(BadConfig, match=f"^{message}") as refused:
        parse_artifacts(text, "--artifacts")
    assert "\n" not in str(refused.value)


def test_a_strength_that_the_variant_has_no_use_for_is_refused() -> None:
    assert artifacts_for("all", [Noise(0, 50), Losses(0.1)]) == Artifacts(Noise(0, 50), Losses(0.1))
    assert artifacts_for("none", []) == Artifacts()
    for variant, artifact, kind in (
        ("none", Noise(), "noise"),
        ("occ+md", Noise(), "noise"),
        ("noise", Losses(0.1), "missing_data"),
        ("noise+md", Occlusion(), "occlusion"),
    ):
        message = f"a strength of {artifact.name} is for a variant that has {kind}, found variant '{variant}'"
        with pytest.raises(BadConfig, match=message.replace("+", r"\+")):
            artifacts_for(variant, [artifact])
    with pytest.raises(BadConfig, match="the variant must be one of"):
        artifacts_for("full", [Noise()])
