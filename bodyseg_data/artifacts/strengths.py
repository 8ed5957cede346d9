"""The strengths of all artifacts: one object of each that images may have."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

from bodyseg_data.artifacts import ARTIFACTS
from bodyseg_data.artifacts.artifact import Artifact
from bodyseg_data.core.errors import BadConfig


@dataclass(frozen=True, init=False, repr=False)
class Artifacts:
    """The artifacts that images may have, and how strong each is; a variant has those of its kinds.

        Artifacts(noise=Noise(0.0, 50.0), losses=Losses(0.4))

    given: artifacts, told apart by their classes. named: the same by their names in the registry, None for an artifact
    that no image is to have. All others are as in the paper. Read by name, `artifacts.noise`, or by iterating.

    Raises BadConfig for an unknown name, an object of another class than its name's, or an artifact given twice.
    """

    _chosen: tuple[tuple[str, Artifact | None], ...]

    def __init__(self, *given: Artifact, **named: Artifact | None) -> None:
        chosen: dict[str, Artifact | None] = {}
        for name, artifact in (*((_name_of(artifact), artifact) for artifact in given), *named.items()):
            kind = _class_of(name)
            if artifact is not None and type(artifact) is not kind:
                raise BadConfig(f"{name} must be of class {kind.__name__}, found {type(artifact).__name__}")
            if name in chosen:
                raise BadConfig(f"an artifact may be given once, found {name} twice")
            chosen[name] = artifact
        usual = {name: kind() if kind.in_paper else None for name, kind in ARTIFACTS.items()}
        object.__setattr__(self, "_chosen", tuple((usual | chosen).items()))

    def __getattr__(self, name: str) -> Any:
        for known, artifact in () if name.startswith("_") else self._chosen:
            if name == known:
                return artifact
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def __iter__(self) -> Iterator[Artifact]:
        """All artifacts but those that no image has, in the order in which they apply."""
        return (artifact for _, artifact in self._chosen if artifact is not None)

    def __repr__(self) -> str:
        return f"Artifacts({', '.join(f'{name}={artifact!r}' for name, artifact in self._chosen)})"

    def to_json(self) -> dict[str, Any]:
        """Name -> strengths, as plain JSON, of the artifacts that have any."""
        tree: dict[str, Any] = json.loads(json.dumps({each.name: asdict(each) for each in self if fields(each)}))
        return tree


def artifacts_from_json(tree: Any, where: str) -> tuple[Artifact, ...]:
    """Artifacts from what `Artifacts.to_json` gives, or a part of it; strengths left out are as in the paper.

    where: names the origin in messages. Raises BadConfig for anything unknown or out of range.
    """
    if not isinstance(tree, Mapping) or not all(isinstance(strengths, Mapping) for strengths in tree.values()):
        raise BadConfig(f'{where} must be strengths by artifact, like {{"noise": {{"high_mm": 50}}}}, found {tree!r}')
    return tuple(_artifact(name, strengths, where) for name, strengths in tree.items())


def parse_artifacts(text: str, where: str) -> tuple[Artifact, ...]:
    """As `artifacts_from_json`, from JSON text."""
    try:
        tree = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise BadConfig(f"{where} must be JSON, found {text!r}: {error}") from error
    return artifacts_from_json(tree, where)


def _artifact(name: str, strengths: Mapping[str, Any], where: str) -> Artifact:
    kind = _class_of(name)
    known = [field.name for field in fields(kind)]
    for strength in strengths:
        if strength not in known:
            allowed = ", ".join(known) or "none"
            raise BadConfig(f"{where}: a strength of {name} must be one of {allowed}, found {strength!r}")
    values = {each: tuple(value) if isinstance(value, list) else value for each, value in strengths.items()}
    try:
        return kind(**values)
    except BadConfig as error:
        raise BadConfig(f"{where}: {error}") from error
    except (TypeError, ValueError, LookupError) as error:
        raise BadConfig(f"{where}: strengths of {name} must be of the right types, found {dict(strengths)}") from error


def _class_of(name: str) -> type[Artifact]:
    if name not in ARTIFACTS:
        raise BadConfig(f"an artifact must be one of {', '.join(ARTIFACTS)}, found {name!r}")
    return ARTIFACTS[name]


def _name_of(artifact: Artifact) -> str:
    name = getattr(artifact, "name", None)
    if not isinstance(name, str):
        raise BadConfig(f"an artifact must be an object of a registered class, found {type(artifact).__name__}")
    return name
