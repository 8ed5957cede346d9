"""A stand-in for the package rerun-sdk: the part of its interface that is used, which keeps what it is given."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

Logged = tuple[str, dict[str, float], tuple["Thing", ...], bool]


class Thing:
    """An archetype: the name of its class and what it was made of."""

    def __init__(self, kind: str, *parts: Any, **facts: Any) -> None:
        self.kind, self.parts, self.facts = kind, parts, facts


class FakeRerun(ModuleType):
    """Archetypes take the arguments of version 0.41 that are used here, and no others. streams: those made."""

    def __init__(self) -> None:
        super().__init__("rerun")
        self.streams: list[FakeStream] = []
        self.blueprint = FakeBlueprint("rerun.blueprint")
        self.ViewCoordinates = type("ViewCoordinates", (), {"RIGHT_HAND_Y_UP": Thing("ViewCoordinates")})

    def RecordingStream(self, name: str) -> FakeStream:  # noqa: N802  its name there
        self.streams.append(FakeStream(name))
        return self.streams[-1]

    def AnnotationContext(self, classes: list[tuple[int, str, tuple[int, ...]]]) -> Thing:  # noqa: N802
        return Thing("AnnotationContext", classes)

    def DepthImage(self, image: Any, *, meter: float, depth_range: tuple[float, float]) -> Thing:  # noqa: N802
        assert image.dtype in (np.uint16, np.float32) and image.ndim == 2
        return Thing("DepthImage", image.copy(), meter=meter, depth_range=depth_range)

    def SegmentationImage(self, image: Any) -> Thing:  # noqa: N802
        assert image.dtype == np.uint8 and image.ndim == 2
        return Thing("SegmentationImage", image.copy())

    def Image(self, image: Any) -> Thing:  # noqa: N802
        assert image.dtype == np.uint8
        return Thing("Image", image.copy())

    def Points3D(self, positions: Any, *, colors: Any, class_ids: Any) -> Thing:  # noqa: N802
        assert positions.shape == colors.shape and (class_ids is None or len(class_ids) == len(positions))
        return Thing("Points3D", positions.copy(), colors=colors.copy(), class_ids=class_ids)

    def Pinhole(self, **facts: Any) -> Thing:  # noqa: N802
        assert {*facts} == {"resolution", "focal_length", "principal_point", "image_plane_distance"}
        return Thing("Pinhole", **facts)

    def Quaternion(self, *, xyzw: tuple[float, ...]) -> Thing:  # noqa: N802
        return Thing("Quaternion", xyzw)

    def Transform3D(self, *, translation: Any, rotation: Thing) -> Thing:  # noqa: N802
        return Thing("Transform3D", translation=translation, rotation=rotation)

    def TextDocument(self, text: str) -> Thing:  # noqa: N802
        return Thing("TextDocument", text)

    def Scalars(self, value: float) -> Thing:  # noqa: N802
        return Thing("Scalars", value)


class FakeStream:
    """A recording: logged has entity, times, things and whether they are static, in order."""

    def __init__(self, name: str) -> None:
        self.name, self.logged = name, list[Logged]()
        self.layout: Any = None
        self._times: dict[str, float] = {}
        self._path = Path()

    def save(self, path: Path, default_blueprint: Thing) -> None:
        path.touch()
        self._path, self.layout = path, default_blueprint

    def reset_time(self) -> None:
        self._times.clear()

    def set_time(self, timeline: str, *, sequence: int | None = None, duration: float | None = None) -> None:
        assert (sequence is None) != (duration is None)
        self._times[timeline] = sequence if sequence is not None else duration or 0.0

    def log(self, entity: str, *things: Thing, static: bool, strict: bool) -> None:
        assert strict and things
        self.logged.append((entity, dict(self._times), things, static))

    def disconnect(self) -> None:
        self._path.write_bytes(b"RRF2")

    def of(self, entity: str) -> list[Thing]:
        """First things logged for an entity, without static ones."""
        return [things[0] for name, _, things, static in self.logged if name == entity and not static]


class FakeBlueprint(ModuleType):
    """Views and containers, as `Thing`."""

    def __getattr__(self, kind: str) -> Any:
        if kind.startswith("_"):
            raise AttributeError(kind)
        return lambda *parts, **facts: Thing(kind, *parts, **facts)
