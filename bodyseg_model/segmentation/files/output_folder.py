"""Folder of the results of `bodyseg segment`: it replaces no file but those of an earlier call on the same frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.files import flush, write_result
from bodyseg_model.networks.checkpoints import read_json, write_json
from bodyseg_model.recordings.recording import Frame

FORMAT: Final = "bodyseg segment 2"
"""Format of `SUMMARY`."""

SUMMARY: Final = "summary.json"
PREVIEW: Final = "preview.gif"
LEGEND: Final = "legend.png"
UNFINISHED: Final = "unfinished.json"
"""Frames of a call that has not ended yet, or was cut short; it goes when `SUMMARY` is written."""

IMAGES: Final = ("labels", "overlay", "undistorted")
"""Folders of images, one a frame."""


class OutputFolder:
    """The folder of one call's results. Nothing is written before `begin`.

    inputs: the paths of the frames, as given. folders: those of `IMAGES` that the call writes. Raises BadConfig for a
    folder that holds frames or lies among them, or that holds anything but an earlier call's results, or results of
    frames that are not among `frames`: these would be lost, or mixed with others.
    """

    def __init__(
        self, path: Path, inputs: Sequence[Path], frames: Sequence[Frame], folders: Sequence[str] = IMAGES[:2]
    ) -> None:
        self.path, self.folders = path, tuple(folders)
        self._frames = [_entry(frame) for frame in frames]
        self._earlier: list[dict[str, Any]] = []
        _check_apart(path, inputs)
        held = _entries(path)
        if held:
            self._earlier = _earlier_frames(path, held)
            same = {frame["path_id"] for frame in self._frames}
            for frame in self._earlier:
                if frame["path_id"] not in same and any(image.exists() for image in self._images(frame["name"])):
                    raise BadConfig(
                        f"--out must not hold results of other frames, found those of {frame['file']} in {path}: "
                        "give a new folder, or delete this one"
                    )

    def __repr__(self) -> str:
        return f"OutputFolder({str(self.path)!r}, {', '.join(self.folders)})"

    def begin(self) -> None:
        """Make the folders. An earlier summary goes first, so that a summary is always of all results; then images of
        the earlier call that this one does not replace, and its preview and legend. Raises BadConfig.
        """
        try:
            for folder in self.folders:
                (self.path / folder).mkdir(parents=True, exist_ok=True)
            write_json(self.path / UNFINISHED, {"format": FORMAT, "each": self._frames})
            for name in (SUMMARY, PREVIEW, LEGEND):
                (self.path / name).unlink(missing_ok=True)
            kept = {self.image(folder, frame["name"]) for folder in self.folders for frame in self._frames}
            for frame in self._earlier:
                for stale in self._images(frame["name"]) - kept:
                    stale.unlink(missing_ok=True)
            for frame in self._frames:
                for folder in self.folders:
                    self.image(folder, frame["name"]).parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise BadConfig(f"cannot write {self.path}: {error.strerror or error}") from error

    def _images(self, name: str) -> set[Path]:
        """Paths of all images that a call may have written of a frame."""
        return {self.image(folder, name) for folder in IMAGES}

    def image(self, folder: str, name: str) -> Path:
        """Path of a frame's image in one of `IMAGES`."""
        return self.path / folder / f"{name}.png"

    def write(self, folder: str, name: str, image: bytes) -> None:
        """Write a frame's image in one of `IMAGES`, whole or not at all. Raises BadConfig, naming it.

        The disk is waited for at the end, in `finish`: four times a frame would keep a slow one from real time.
        """
        write_result(self.image(folder, name), image, flushed=False)

    def finish(self, summary: Mapping[str, Any]) -> None:
        """Write the summary once the disk holds all images: `each` has an entry for every frame, in order, but those of
        the names in `skipped`. Raises BadConfig.
        """
        skipped = {frame["name"] for frame in summary.get("skipped", ())}
        frames = [frame for frame in self._frames if frame["name"] not in skipped]
        each = [{**frame, **entry} for frame, entry in zip(frames, summary["each"], strict=True)]
        try:
            flush([self.image(folder, frame["name"]) for folder in self.folders for frame in frames])
            write_json(self.path / SUMMARY, {"format": FORMAT, **summary, "each": each})
            (self.path / UNFINISHED).unlink(missing_ok=True)
        except OSError as error:
            raise BadConfig(f"cannot write {self.path}: {error.strerror or error}") from error


def _entry(frame: Frame) -> dict[str, Any]:
    time = {} if frame.time_s is None else {"time_s": frame.time_s}
    return {"name": frame.name, "file": frame.where, "path_id": frame.path_id, **time}


def _check_apart(out: Path, inputs: Sequence[Path]) -> None:
    place = out.resolve()
    for path in inputs:
        full = path.resolve()
        if full.is_relative_to(place) or (full.is_dir() and place.is_relative_to(full)):
            raise BadConfig(f"--out must lie outside the frames' folders and hold no frames, found {out} and {path}")


def _entries(out: Path) -> list[str]:
    """Names of a folder's entries, hidden ones aside; none if it does not exist. Raises BadConfig for a file."""
    try:
        return sorted(entry.name for entry in out.iterdir() if not entry.name.startswith("."))
    except FileNotFoundError:
        return []
    except OSError as error:
        raise BadConfig(f"cannot write {out}: {error.strerror or error}") from error


def _earlier_frames(out: Path, held: Sequence[str]) -> list[dict[str, Any]]:
    """Name and file of every frame of an earlier call, from its summary or, if it was cut short, from `UNFINISHED`."""
    strange = [name for name in held if name not in (SUMMARY, UNFINISHED, PREVIEW, LEGEND, *IMAGES)]
    notes = [name for name in (UNFINISHED, SUMMARY) if name in held]
    if strange or not notes:
        raise BadConfig(
            f"--out must be a new folder, or one of earlier results of `bodyseg segment`: {out} holds "
            f"{(strange or held)[0]}"
        )
    frames: dict[str, dict[str, Any]] = {}
    for name in notes:
        tree = read_json(out / name)
        each = tree.get("each")
        if tree.get("format") != FORMAT or not isinstance(each, list) or not all(map(_is_frame, each)):
            raise BadConfig(
                f"--out must be a new folder, or one of earlier results of `bodyseg segment`: {out / name} is not of "
                f"format {FORMAT!r}"
            )
        frames |= {frame["name"]: frame for frame in each}
    return list(frames.values())


def _is_frame(entry: Any) -> bool:
    """True for an entry that names a frame's results within the folder, and the frame."""
    texts = [entry.get(key) for key in ("name", "file", "path_id")] if isinstance(entry, dict) else [None]
    return all(isinstance(text, str) for text in texts) and not {"", ".", ".."} & set(entry["name"].split("/"))
