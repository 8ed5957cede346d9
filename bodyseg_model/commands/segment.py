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
from bodyseg_data.core.labels.label_map import PARTS33, LabelMap
from bodyseg_data.core.rig import Rig, rig_names
from bodyseg_data.core.system.machine import hardware
from bodyseg_data.core.system.memory import peak_mb
from bodyseg_data.drawing.style import save_picture
from bodyseg_model.evaluation.frame_times import Stopwatch
from bodyseg_model.networks.checkpoints import Trained, shipped_network
from bodyseg_model.networks.registry import device_of
from bodyseg_model.runtimes.backends import (
    BACKEND_HELP,
    PRECISION_HELP,
    BackendName,
    backend_of,
    load_run,
    put_on_backend,
    to_device,
)
from bodyseg_model.runtimes.onnx_files import Precision
from bodyseg_model.segmentation.cameras import FrameCamera, frame_camera
from bodyseg_model.segmentation.files.camera_files import FrameCameras, Intrinsics, cameras_beside
from bodyseg_model.segmentation.files.output_folder import IMAGES, LEGEND, PREVIEW, OutputFolder
from bodyseg_model.segmentation.foreground import Background, BackgroundMode
from bodyseg_model.segmentation.frames import FrameFile, find_frames, metres_a_step, to_metres
from bodyseg_model.segmentation.overlay import Preview, draw_overlay, draw_parts_legend
from bodyseg_model.segmentation.people.person_score import shipped_score
from bodyseg_model.segmentation.segmenter import Segmenters
from bodyseg_model.segmentation.sequence_summary import STAGES, SequenceSummary
from bodyseg_model.sensor_fit.shadows import ShadowFrames

EXAMPLE = "bodyseg segment recording/ --focal 525 --out labelled"

_OF_THE_CARD: Final = ("network", "variant", "seed", "steps", "data", "rig", "sensor", "weights_sha256")
_UNDISTORTED: Final = IMAGES[2]
_NEAR: Final = 0.7  # of the stand-off; docs/segment.md has the accuracy by distance
_SHADOW_FRAMES: Final = 8  # whose shadows tell whether a recording is mirrored


@dataclass(frozen=True)
class Options:
    """Options of `bodyseg segment`."""

    frames: tuple[Path, ...] = option("16-bit grey PNGs, folders of them or tars (.tar) of them", positional=True)
    out: Path = option("folder for labels, overlays, preview.gif, legend.png and summary.json")
    run: Path | None = option("a training's folder, a .safetensors or .onnx file (default: the one that ships)", None)
    backend: BackendName | None = option(BACKEND_HELP, None)
    precision: Precision | None = option(PRECISION_HELP, None)
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
    step_m, background = metres_a_step(options.units), _background(options)
    frames = find_frames(options.frames)
    trained = shipped_network() if options.run is None else load_run(options.run)
    trained = put_on_backend(trained, options.backend, options.precision)
    label_map, preview = trained.label_map, Preview(options.fps, trained.label_map)
    to_device(trained.network, options.device)
    cameras = _cameras(options, frames, trained)
    # Of other classes than the 33 parts, things are told by their shape alone.
    score = None if options.keep_things else shipped_score("parts" if label_map == PARTS33 else "shape")
    segmenters = Segmenters(trained, background, options.mirrored, options.confidence, score)
    _, first = segmenters.of(cameras.first.camera)  # now, as nothing is made for options that cannot be
    out = OutputFolder(options.out, options.frames, frames, IMAGES if cameras.bent else IMAGES[:2])
    out.begin()

    summary, shadows = SequenceSummary(), ShadowFrames(len(frames), _SHADOW_FRAMES)
    with Progress("segmenting", "frames") as progress:
        for number, frame in enumerate(frames):
            range_m, bodies = _segment(frame, cameras, step_m, segmenters, out, summary, preview, label_map)
            if not cameras.is_own(frame):
                shadows.add(number, frame.name, range_m, bodies)
            progress.update(number + 1, len(frames))
    save_picture(draw_parts_legend(label_map), options.out / LEGEND)
    write_result(options.out / PREVIEW, preview.to_gif())
    facts = {
        "network": {"file": "shipped" if options.run is None else str(options.run), **_facts(trained)},
        "labels": {"name": label_map.name, "classes": [*label_map.names]},
        "camera": {**cameras.to_json(), "mirrored": options.mirrored},
        "unit_m": step_m,
        "background": background.to_json(),
        "person_score": None if first.people is None else {"model": first.people.model, "cutoff": first.people.cutoff},
        "resampling": {
            "rig": trained.rig.name,
            "focal_px": trained.rig.camera.focal_px,
            "distance_m": trained.rig.stand_off_m,
            "rule": "each body is scaled so that its median range gets the pixel size of that camera at that distance",
        },
        "least_confidence": options.confidence,
        "preview": {"frames": len(preview), "frames_per_second": round(preview.frames_per_second, 2)},
        "hardware": hardware(),
        "device": str(device_of(trained.network)),
        "runtime": backend_of(trained.network),
        "peak_mb": peak_mb(),
    }
    out.finish({**facts, **summary.to_json()})
    lines = _remarks(options, cameras, summary, shadows) + _too_near(summary, trained.rig)
    sys.stderr.write("".join(f"{line}\n" for line in lines))
    return 0


def _cameras(options: Options, frames: Sequence[FrameFile], trained: Trained) -> FrameCameras:
    """Cameras of all frames: the one that options give, or those in files beside frames and one for all others."""
    given = options.rig is not None or options.focal is not None or bool(options.centre)
    beside: list[Intrinsics | None] = [None] * len(frames) if given else cameras_beside(frames)

    def choose(shape: tuple[int, int], where: str) -> FrameCamera:
        return frame_camera(shape, where, options.rig, options.focal, options.centre, trained.rig)

    return FrameCameras(frames, beside, choose)


def _segment(
    frame: FrameFile,
    cameras: FrameCameras,
    step_m: float,
    segmenters: Segmenters,
    out: OutputFolder,
    summary: SequenceSummary,
    preview: Preview,
    label_map: LabelMap,
) -> tuple[NDArray[np.float32], list[NDArray[np.intp]]]:
    """Read, label, write and count one frame; returns its ranges and the pixels of its bodies.

    Raises BadConfig, naming it, before anything of it is written.
    """
    watch = Stopwatch(STAGES)
    with watch("read"):
        pixels = frame.read()
        camera = cameras.of(frame, (pixels.shape[0], pixels.shape[1]))
        try:
            lens, segmenter = segmenters.of(camera.camera)
            if lens is not None:
                pixels = lens(pixels)
            range_m = to_metres(pixels, step_m)
        except BadConfig as error:
            raise BadConfig(f"{frame.where}: {error}") from error
    try:
        result = segmenter(range_m)
    except BadConfig as error:
        raise BadConfig(f"{frame.where}: {error}") from error
    with watch("write"):
        overlay = draw_overlay(range_m, result.labels, [body.pixels for body in result.bodies], label_map)
        images: dict[str, NDArray[Any]] = {"labels": result.labels, "overlay": overlay}
        if _UNDISTORTED in out.folders:
            images[_UNDISTORTED] = pixels
        for folder, image in images.items():
            buffer = io.BytesIO()
            Image.fromarray(image).save(buffer, "PNG", compress_level=3)  # a third of the time, a tenth more bytes
            write_result(out.image(folder, frame.name), buffer.getvalue())
    if overlay.shape[:2] == (cameras.first.camera.rows, cameras.first.camera.columns):
        preview.add(overlay)  # an animation has frames of one size
    own = camera.to_json() if cameras.is_own(frame) else None
    times = {**watch.milliseconds, **result.milliseconds}
    summary.add(frame.name, frame.where, range_m, result, times, frame.sequence, own)
    return range_m, [body.pixels for body in result.bodies]


def _background(options: Options) -> Background:
    limits = {"near_m": options.near, "far_m": options.far}
    given = {name: limit for name, limit in limits.items() if limit is not None}
    if given and options.background == "keep":
        raise BadConfig("--near and --far limit what is kept: they contradict --background keep")
    return Background(options.background, **given)


def _facts(trained: Trained) -> dict[str, Any]:
    """Entries of the network's card that identify it, and how it was trained."""
    return {name: trained.card[name] for name in _OF_THE_CARD if name in trained.card}


def _remarks(options: Options, cameras: FrameCameras, summary: SequenceSummary, shadows: ShadowFrames) -> list[str]:
    """Lines for standard error: the results, and warnings about what looks wrong."""
    frames, camera = shadows.frames, cameras.common or cameras.first
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


def _too_near(summary: SequenceSummary, rig: Rig) -> list[str]:
    """A line where most bodies are much nearer than those trained on: their perspective cannot be resampled."""
    range_m = summary.median_range_m
    if range_m is None or range_m >= _NEAR * rig.stand_off_m:
        return []
    return [
        f"bodies are {range_m:.2g} m away, the network was trained for {rig.stand_off_m:.2g} m (rig {rig.name}): "
        "so near, labels are less accurate"
    ]
