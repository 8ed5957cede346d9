"""`bodyseg segment`: find the parts of people in frames of a range sensor."""

from __future__ import annotations

import io
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from bodyseg_data.commands.options import option
from bodyseg_data.commands.progress import Progress
from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.files import write_result
from bodyseg_data.core.rig import rig_names
from bodyseg_data.core.system.machine import hardware
from bodyseg_data.drawing.style import save_picture
from bodyseg_model.evaluation.frame_times import Stopwatch
from bodyseg_model.networks.checkpoints import Trained, load_network, shipped_network, write_json
from bodyseg_model.segmentation.cameras import FrameCamera, frame_camera
from bodyseg_model.segmentation.foreground import Background, BackgroundMode
from bodyseg_model.segmentation.frames import FrameFile, find_frames, metres_a_step, to_metres
from bodyseg_model.segmentation.overlay import Preview, draw_overlay, draw_parts_legend
from bodyseg_model.segmentation.people.person_score import shipped_score
from bodyseg_model.segmentation.segmenter import Segmenter
from bodyseg_model.segmentation.sequence_summary import STAGES, SequenceSummary
from bodyseg_model.segmentation.undistortion import Undistortion
from bodyseg_model.sensor_fit.shadows import ShadowFrames
from bodyseg_model.training.distributed import find_device

EXAMPLE = "bodyseg segment recording/ --focal 525 --out labelled"

_FORMAT: Final = "bodyseg segment 1"
_SUMMARY: Final = "summary.json"
_PREVIEW: Final = "preview.gif"
_RESULTS: Final = ("labels", "overlay")
_UNDISTORTED: Final = "undistorted"
_SHADOW_FRAMES: Final = 8  # whose shadows tell whether a recording is mirrored


@dataclass(frozen=True)
class Options:
    """Options of `bodyseg segment`."""

    frames: tuple[Path, ...] = option("16-bit grey PNGs, folders of them or tars (.tar) of them", positional=True)
    out: Path = option("folder for labels, overlays, preview.gif, legend.png and summary.json")
    run: Path | None = option("a training's folder, or a .safetensors file (default: the network that ships)", None)
    units: str = option("size of one step of a frame: mm, 0.1mm, cm ...", "mm")
    rig: str | None = option(f"frames are from this camera: {', '.join(rig_names())} or a rig file (.toml)", None)
    focal: float | None = option("focal length of the camera, pixels (default: told by the frames' size)", None)
    centre: tuple[float, ...] = option("principal point of the camera, x y (default: the image's middle)", ())
    mirrored: bool = option("frames show left for right, as some drivers give them", False)
    background: BackgroundMode = option(
        "people: keep what is within the limits, on no large plane and of a body's size; limits: keep what is within "
        "them, as one body; keep: keep all that was measured, as one body",
        "people",
    )
    keep_things: bool = option("label chairs, boxes and other things of a body's size like people", False)
    near: float | None = option("the near limit, metres (default: 0.5)", None)
    far: float | None = option("the far limit, metres (default: 5)", None)
    confidence: float = option("give no label to pixels of less confidence, 0 to 1", 0.0)
    fps: float = option("frames per second of preview.gif", 10.0)
    device: str | None = option("cpu, cuda, cuda:1 ... (default: a GPU if there is one)", None)


def run(options: Options) -> int:
    """Label every frame, then write the summary."""
    step_m, background, preview = metres_a_step(options.units), _background(options), Preview(options.fps)
    frames = find_frames(options.frames)
    first = frames[0].read()
    camera = frame_camera((first.shape[0], first.shape[1]), frames[0].where, options.rig, options.focal, options.centre)
    trained = shipped_network() if options.run is None else load_network(options.run)
    trained.network.to(find_device(options.device))
    lens = None if camera.camera.distortion is None else Undistortion(camera.camera)
    ideal = camera.camera if lens is None else lens.camera
    # Of other classes than the 33 parts, the card says which: things are then told by their shape alone.
    score = None if options.keep_things else shipped_score("shape" if "labels" in trained.card else "parts")
    segmenter = Segmenter(trained.network, ideal, background, options.mirrored, options.confidence, people=score)
    folders = _RESULTS if lens is None else (*_RESULTS, _UNDISTORTED)
    _make_folders(options.out, folders)

    summary, shadows = SequenceSummary(), ShadowFrames(len(frames), _SHADOW_FRAMES)
    with Progress("segmenting", "frames") as progress:
        for number, frame in enumerate(frames):
            range_m, bodies = _segment(frame, lens, step_m, segmenter, options.out, summary, preview)
            shadows.add(number, frame.name, range_m, bodies)
            progress.update(number + 1, len(frames))
    save_picture(draw_parts_legend(), options.out / "legend.png")
    write_result(options.out / _PREVIEW, preview.to_gif())
    facts = {
        "format": _FORMAT,
        "network": {"file": "shipped" if options.run is None else str(options.run), **_facts(trained)},
        "camera": {**camera.to_json(), "mirrored": options.mirrored},
        "unit_m": step_m,
        "background": background.to_json(),
        "person_score": None
        if segmenter.people is None
        else {"model": segmenter.people.model, "cutoff": segmenter.people.cutoff},
        "resampling": {
            "focal_px": segmenter.rig.camera.focal_px,
            "distance_m": segmenter.rig.stand_off_m,
            "rule": "each body is scaled so that its median range gets the pixel size of that camera at that distance",
        },
        "least_confidence": options.confidence,
        "preview": {"frames": len(preview), "frames_per_second": round(preview.frames_per_second, 2)},
        "hardware": hardware(),
        "device": str(segmenter.device),
    }
    write_json(options.out / _SUMMARY, {**facts, **summary.to_json()})
    sys.stderr.write("".join(f"{line}\n" for line in _remarks(options, camera, summary, shadows)))
    return 0


def _read(frame: FrameFile, lens: Undistortion | None) -> NDArray[np.uint16]:
    pixels = frame.read()
    try:
        return pixels if lens is None else lens(pixels)
    except BadConfig as error:
        raise BadConfig(f"{frame.where}: {error}") from error


def _segment(
    frame: FrameFile,
    lens: Undistortion | None,
    step_m: float,
    segmenter: Segmenter,
    out: Path,
    summary: SequenceSummary,
    preview: Preview,
) -> tuple[NDArray[np.float32], list[NDArray[np.intp]]]:
    """Read, label, write and count one frame; returns its ranges and the pixels of its bodies.

    Raises BadConfig, naming it, before anything of it is written.
    """
    watch = Stopwatch(STAGES)
    with watch("read"):
        pixels = _read(frame, lens)
        range_m = to_metres(pixels, step_m)
    try:
        result = segmenter(range_m)
    except BadConfig as error:
        raise BadConfig(f"{frame.where}: {error}") from error
    with watch("write"):
        overlay = draw_overlay(range_m, result.labels, [body.pixels for body in result.bodies])
        images: dict[str, NDArray[Any]] = {"labels": result.labels, "overlay": overlay}
        if lens is not None:
            images[_UNDISTORTED] = pixels
        for folder, image in images.items():
            buffer = io.BytesIO()
            Image.fromarray(image).save(buffer, "PNG", compress_level=3)  # a third of the time, a tenth more bytes
            write_result(out / folder / f"{frame.name}.png", buffer.getvalue())
    preview.add(overlay)
    summary.add(frame.name, frame.where, range_m, result, {**watch.milliseconds, **result.milliseconds})
    return range_m, [body.pixels for body in result.bodies]


def _background(options: Options) -> Background:
    limits = {"near_m": options.near, "far_m": options.far}
    given = {name: limit for name, limit in limits.items() if limit is not None}
    if given and options.background == "keep":
        raise BadConfig("--near and --far limit what is kept: they contradict --background keep")
    return Background(options.background, **given)


def _make_folders(out: Path, folders: Sequence[str]) -> None:
    """Make the folders of results. An earlier summary is deleted first, so that a summary is always of all results."""
    try:
        for folder in folders:
            (out / folder).mkdir(parents=True, exist_ok=True)
        (out / _SUMMARY).unlink(missing_ok=True)
    except OSError as error:
        raise BadConfig(f"cannot write {out}: {error.strerror or error}") from error


def _facts(trained: Trained) -> dict[str, Any]:
    """Entries of the network's card that identify it."""
    return {
        name: trained.card[name] for name in ("network", "variant", "seed", "steps", "data") if name in trained.card
    }


def _remarks(options: Options, camera: FrameCamera, summary: SequenceSummary, shadows: ShadowFrames) -> list[str]:
    """Lines for standard error: the results, and warnings about what looks wrong."""
    frames = shadows.frames
    lines = [f"wrote {frames} frames to {options.out}, {summary.milliseconds['frame']['mean']:.0f} ms a frame"]
    if summary.mean_confidence is not None:
        lines[0] += f", {summary.people / frames:.2g} people a frame, mean confidence {summary.mean_confidence:.0%}"
    else:
        lines.append("nobody was found: are --units, --near and --far right?")
    if summary.things:
        lines.append(f"{summary.things / frames:.2g} things a frame got no label: --keep-things labels them, too")
    if camera.assumed:
        lines.append(f"camera {camera.origin}: give --focal or --rig if it is another")
    mirrored = shadows.mirrored(camera)
    if mirrored is not None and mirrored != options.mirrored:
        shown = "mirrored: give" if mirrored else "not mirrored: leave out"
        lines.append(
            f"the projector's shadows lie on the {camera.projector_side if mirrored else 'other'} side of bodies, so "
            f"frames are probably {shown} --mirrored"
        )
    return lines
