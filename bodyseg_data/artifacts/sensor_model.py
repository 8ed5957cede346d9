"""Sensor models: the artifacts that a sensor has, in the order in which they apply; in Python, TOML and JSON."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, Final

from bodyseg_data.artifacts.artifact import Artifact
from bodyseg_data.artifacts.registry import artifact_class, check_artifact_class
from bodyseg_data.core import BadConfig, check_choice, reported
from bodyseg_data.files import Table, TomlFiles

SENSOR_FORMAT: Final = "bodyseg sensor 1"
PAPER_SENSOR: Final = "paper"
"""The default sensor model: the artifacts of the paper's Table 1."""

_FILES: Final = TomlFiles("sensor", resources.files(__package__) / "sensors", SENSOR_FORMAT)
_NAME: Final = re.compile(r"[A-Za-z0-9_+.-]{1,40}")

_DISTINCT: Final[Mapping[str, Callable[[Artifact], Iterable[str]]]] = {
    "names": lambda artifact: (artifact.name,),
    "purposes": lambda artifact: artifact.purposes,
    "drawn quantities": lambda artifact: artifact.drawn,
}
"""Names that no two artifacts of a model may share."""


@dataclass(frozen=True, repr=False)
class SensorModel:
    """The artifacts of a sensor, in the order in which they apply.

        SensorModel("mine", (Occlusion(), Noise(0.0, 5.0), MissingData((0.1,))))
        load_sensor_model("paper").with_artifacts(Noise(0.0, 50.0))

    name: one plain word of at most 40 letters. title: the sensor's name in prose.

    An artifact draws the same numbers in every model, since draws belong to (seed, epoch, sample key, purpose). Raises
    BadConfig for an object that is no artifact, for a strength that is no plain JSON, for an artifact given twice, and
    for artifacts that share a purpose of random numbers or the name of a drawn quantity.
    """

    name: str
    artifacts: tuple[Artifact, ...] = ()
    title: str = ""

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not _NAME.fullmatch(self.name):
            raise BadConfig(f"a sensor's name must be one plain word of at most 40 letters, found {self.name!r:.60}")
        if not isinstance(self.title, str):
            raise BadConfig(f"sensor {self.name}: the title must be text, found {self.title!r:.60}")
        given: Any = self.artifacts
        if not isinstance(given, tuple | list):
            raise BadConfig(f"sensor {self.name}: artifacts must be a tuple of them, found {type(given).__name__}")
        object.__setattr__(self, "artifacts", tuple(given))
        for artifact in self.artifacts:
            check_artifact_class(type(artifact), f"sensor {self.name}")
        with reported(f"sensor {self.name}: title and strengths must be plain JSON", BadConfig, TypeError, ValueError):
            json.dumps(self.to_json(), ensure_ascii=False).encode()  # half of a pair of surrogates is no letter
        for what, names in _DISTINCT.items():
            owners: dict[str, str] = {}
            for artifact in self.artifacts:
                for name in names(artifact):
                    if name in owners:
                        raise BadConfig(
                            f"sensor {self.name}: {what} of artifacts must differ, found {name!r} of {owners[name]} "
                            f"and {artifact.name}"
                        )
                    owners[name] = artifact.name

    def __iter__(self) -> Iterator[Artifact]:
        return iter(self.artifacts)

    def __len__(self) -> int:
        return len(self.artifacts)

    def __repr__(self) -> str:
        return f"SensorModel({self.name!r}, {', '.join(map(repr, self.artifacts)) or 'no artifacts'})"

    def with_artifacts(self, *given: Artifact) -> SensorModel:
        """Return the model with other strengths: a given artifact replaces the one of its name, or else is added last.

        Raises BadConfig for an artifact that is given twice; otherwise as `SensorModel`.
        """
        by_name, names = {artifact.name: artifact for artifact in self.artifacts}, set[str]()
        for artifact in given:
            check_artifact_class(type(artifact), f"sensor {self.name}")
            if artifact.name in names:
                raise BadConfig(f"an artifact may be given once, found {artifact.name} twice")
            names.add(artifact.name)
            by_name[artifact.name] = artifact
        return replace(self, artifacts=tuple(by_name.values()))

    def without(self, *names: str) -> SensorModel:
        """Return the model without the artifacts of these names. Raises BadConfig for a name that it does not have."""
        held = [artifact.name for artifact in self.artifacts]
        for name in names:
            if name not in held:
                raise BadConfig(f"sensor {self.name} has no {name!r}: its artifacts are {', '.join(held) or 'none'}")
        return replace(self, artifacts=tuple(each for each in self.artifacts if each.name not in names))

    def caption(self, drawn: Mapping[str, float]) -> str:
        """Put the quantities drawn for an image (`RangeImage.drawn`) in words: "noise 23 mm, 5% missing"."""
        captions = {name: text for artifact in self for name, text in artifact.drawn.items()}
        return ", ".join(captions[name].format(value) for name, value in drawn.items())

    def to_json(self) -> dict[str, Any]:
        """Return the model as plain JSON: format, name, title, and `artifacts_to_json`."""
        return {
            "format": SENSOR_FORMAT,
            "name": self.name,
            "title": self.title,
            "artifacts": artifacts_to_json(self.artifacts),
        }

    def to_toml(self, comments: Mapping[str, str] | None = None) -> str:
        """Return the model as the text of a sensor file, which `load_sensor_model` reads.

        comments: text to write above an artifact, by its name; "" for above the whole file.
        """
        comments = comments or {}
        lines = [*_comment(comments.get("", "")), f"format = {_toml(SENSOR_FORMAT)}", f"name = {_toml(self.name)}"]
        if self.title:
            lines.append(f"title = {_toml(self.title)}")
        for artifact in self.artifacts:
            lines += ["", *_comment(comments.get(artifact.name, "")), "[[artifacts]]"]
            lines.append(f"artifact = {_toml(artifact.name)}")
            strengths = asdict(artifact).items()
            lines += [f"{name} = {_toml(value)}" for name, value in strengths if value is not None]
        return "\n".join(lines) + "\n"


def artifacts_to_json(artifacts: Sequence[Artifact]) -> list[dict[str, Any]]:
    """Artifacts as plain JSON, in order: name, version of the code, strengths."""
    tree: list[dict[str, Any]] = json.loads(
        json.dumps([{"artifact": each.name, "version": each.version} | asdict(each) for each in artifacts])
    )
    return tree


def sensor_model_names() -> tuple[str, ...]:
    """Names of the sensor files that ship with the package, in alphabetical order."""
    return _FILES.names()


def load_sensor_model(sensor: str | Path | SensorModel = PAPER_SENSOR) -> SensorModel:
    """Load a sensor model by the name of one that ships with the package, or from a TOML file (docs/how-to/sensors.md).

    Returns a SensorModel as it is. Raises BadConfig, with file and key, for anything missing, unknown or out of range.
    """
    if isinstance(sensor, SensorModel):
        return sensor
    return _shipped(sensor) if sensor in sensor_model_names() else _read(sensor)


def _read(name_or_path: str | Path) -> SensorModel:
    return parse_sensor_model(_FILES.read(name_or_path), str(name_or_path))


_shipped = cache(_read)  # the default is read for every set; a user's file may change


def parse_sensor_model(text: str, where: str) -> SensorModel:
    """Parse a sensor file's text; `where` names its origin in messages. Raises BadConfig as `load_sensor_model`."""
    return _model(_FILES.parse(text, where), f"sensor {where}")


def sensor_model_from_json(tree: Any, where: str) -> SensorModel:
    """Rebuild a sensor model from what `SensorModel.to_json` gave, or its name and artifacts alone.

    where: names its origin in messages. Raises BadConfig as `load_sensor_model`, also for an artifact that is not
    installed or of another version.
    """
    if not isinstance(tree, dict) or tree.get("format", SENSOR_FORMAT) != SENSOR_FORMAT:
        raise BadConfig(f"{where}: a stored sensor must be an object with name and artifacts, of {SENSOR_FORMAT!r}")
    return _model({key: value for key, value in tree.items() if key != "format"}, where)


def parse_artifacts(text: str, where: str, sensor: SensorModel) -> tuple[Artifact, ...]:
    """Artifacts of given strengths, JSON text: {name: {strength: value}}.

    Strengths left out are those of the sensor's artifact of that name, or else its class's defaults. where: names the
    origin in messages. Raises BadConfig for anything unknown or out of range.
    """
    with reported(f"{where} must be JSON, found {text!r}", BadConfig, ValueError, RecursionError):
        tree = json.loads(text)
    if not isinstance(tree, dict) or not all(isinstance(strengths, dict) for strengths in tree.values()):
        raise BadConfig(f'{where} must be strengths by artifact, like {{"noise": {{"high_mm": 50}}}}, found {tree!r}')
    own = {artifact.name: artifact for artifact in sensor}
    return tuple(_artifact(name, _left(own.get(name), given) | dict(given), where) for name, given in tree.items())


def _left(artifact: Artifact | None, given: Mapping[str, Any]) -> dict[str, Any]:
    """Strengths of a sensor's artifact that given ones leave as they are."""
    if artifact is None:
        return {}
    replaced = artifact.either if given.keys() & {*artifact.either} else ()
    return {name: value for name, value in asdict(artifact).items() if name not in replaced}


def _model(tree: dict[str, Any], where: str) -> SensorModel:
    """A model from a tree without its `format`."""
    artifacts = tree.pop("artifacts", [])
    table = Table(tree, where)
    name = table.text("name")
    title = table.text("title") if "title" in table else ""
    table.finish()
    if not isinstance(artifacts, list) or not all(isinstance(entry, dict) for entry in artifacts):
        raise BadConfig(f"{where}: 'artifacts' must be tables [[artifacts]]")
    found = tuple(_entry(entry, where) for entry in artifacts)
    with reported(where, BadConfig):
        return SensorModel(name, found, title)


def _entry(entry: Mapping[str, Any], where: str) -> Artifact:
    """One [[artifacts]] table; `version`, where given, must be that of the installed code."""
    strengths = dict(entry)
    name, version = strengths.pop("artifact", None), strengths.pop("version", None)
    if not isinstance(name, str):
        raise BadConfig(f"{where}: [[artifacts]] must name its 'artifact', found {name!r}")
    artifact = _artifact(name, strengths, where)
    if version not in (None, artifact.version) or isinstance(version, bool):
        raise BadConfig(f"{where}: {name} is of version {version!r}, installed is version {artifact.version}")
    return artifact


def _artifact(name: str, strengths: Mapping[str, Any], where: str) -> Artifact:
    with reported(where, BadConfig):
        kind = artifact_class(name)
        known = [field.name for field in fields(kind)]
        for strength in strengths:
            check_choice(f"a strength of {name}", strength, known)
        try:
            return kind(**strengths)
        except (TypeError, ValueError, LookupError) as error:
            raise BadConfig(f"strengths of {name} must be of the right types, found {dict(strengths)}") from error


def _comment(text: str) -> list[str]:
    return [f"# {line}".rstrip() for line in text.splitlines()]


def _toml(value: Any) -> str:
    """A strength as TOML. Raises BadConfig for a value that TOML cannot hold."""
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, bool | int | str):
        text = json.dumps(value, ensure_ascii=False)  # JSON's pairs of escapes are no TOML, nor is a plain DEL
        return re.sub("[^ -~]", lambda letter: f"\\U{ord(letter[0]):08X}", text)
    if isinstance(value, float) and math.isfinite(value):
        return repr(value)
    raise BadConfig(f"a sensor file holds text, numbers, flags and lists of them, found {value!r}")
