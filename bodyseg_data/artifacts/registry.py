"""Artifacts of range sensors in clean range images. A new one is a file in this folder and an entry below.

Packages of users add theirs by the entry point `bodyseg.artifacts`: name -> class.
"""

from collections.abc import Mapping
from dataclasses import is_dataclass
from importlib import metadata
from typing import Any, Final, cast, get_args

from bodyseg_data.artifacts.artifact import Artifact, Kind
from bodyseg_data.artifacts.lost_pixels import Losses, PatchLoss, StripeLoss
from bodyseg_data.artifacts.missing_data import MissingData
from bodyseg_data.artifacts.mixed_pixels import MixedPixels
from bodyseg_data.artifacts.noise import Noise
from bodyseg_data.artifacts.occlusion import Occlusion
from bodyseg_data.artifacts.phase_shift import PhaseShift
from bodyseg_data.core import BadConfig, check_choice, reported

ARTIFACTS: Final[dict[str, type[Artifact]]] = {
    kind.name: kind for kind in (Occlusion, Noise, MissingData, Losses, MixedPixels, PatchLoss, StripeLoss, PhaseShift)
}
"""Name -> class of the artifacts that ship with this package; the first three are those of the paper's Table 1."""

ENTRY_POINT: Final = "bodyseg.artifacts"
"""Group of the entry points by which an installed package adds artifacts."""


def artifact_class(name: str) -> type[Artifact]:
    """Return the class of an artifact by its name: one of `ARTIFACTS`, or one that an installed package adds.

    Raises BadConfig for an unknown name, or an entry point that cannot be loaded or breaks the protocol's rules.
    """
    if name in ARTIFACTS:
        return ARTIFACTS[name]
    added = {entry.name: entry for entry in metadata.entry_points(group=ENTRY_POINT)}
    check_choice("an artifact", name, (*ARTIFACTS, *added))
    where = f"entry point {name} = {added[name].value!r} of {ENTRY_POINT}"
    with reported(f"{where} cannot be loaded", BadConfig, Exception):  # whatever the user's module raises
        found = added[name].load()
    kind = check_artifact_class(found, where)
    if kind.name != name:
        raise BadConfig(f"{where}: the artifact must be called as its entry point, found {kind.name!r}")
    return kind


def check_artifact_class(kind: Any, where: str) -> type[Artifact]:
    """Return a class if it keeps the protocol's rules. Raises BadConfig, naming `where`, for one that does not."""
    if not (isinstance(kind, type) and Artifact in kind.__mro__ and is_dataclass(kind)):
        shown = "a class: call it" if type in getattr(kind, "__mro__", ()) else getattr(kind, "__name__", repr(kind))
        raise BadConfig(f"{where}: an artifact must be a dataclass derived from Artifact, found {shown}")
    if not kind.__dataclass_params__.frozen:  # type: ignore[attr-defined]
        raise BadConfig(f"{where}: an artifact must be a frozen dataclass, found {kind.__name__}")
    if not isinstance(getattr(kind, "name", None), str) or getattr(kind, "kind", None) not in get_args(Kind):
        raise BadConfig(
            f"{where}: an artifact must have a name and one kind of {', '.join(get_args(Kind))}, found {kind.__name__}"
        )
    found = cast(type[Artifact], kind)
    if not isinstance(found.purposes, tuple) or not isinstance(found.drawn, Mapping):
        raise BadConfig(f"{where}: purposes must be a tuple, and drawn a dict, name -> caption, in {found.__name__}")
    if ARTIFACTS.get(found.name, found) is not found:  # by its name, a network's card would give the other one
        raise BadConfig(f"{where}: {found.name!r} is the name of another artifact, found {found.__name__}")
    return found
