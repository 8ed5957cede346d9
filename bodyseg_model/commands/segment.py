"""`bodyseg segment`: find the parts of people in frames of a range sensor."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

from bodyseg_data.commands.options import option
from bodyseg_data.commands.progress import Progress, rate_text
from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.files import write_result
from bodyseg_data.core.labels.label_map import LabelMap
from bodyseg_data.core.rig import Rig, rig_names
from bodyseg_data.core.system.machine import hardware
from bodyseg_data.core.system.memory import keep_freed_memory, peak_mb
from bodyseg_data.drawing.style import save_picture
from bodyseg_model.evaluation.frame_times import Stopwatch
from bodyseg_model.networks.checkpoints import Trained, shipped_network
from bodyseg_model.networks.registry import device_of
from bodyseg_model.recordings.bags.labels_out import LabelsOut, labels_out
from bodyseg_model.recordings.camera_files import FrameCameras, find_cameras
from bodyseg_model.recordings.frames import RECORDINGS_HELP, UNITS_HELP, find_frames, metres_a_step, to_metres
from bodyseg_model.recordings.recording import Frame, Pixels, Stamp
from bodyseg_model.recordings.skipping import Skipping
from bodyseg_model.runtimes.backends import (
    BACKEND_HELP,
    FLIP_HELP,
    QUICK_PRECISION_HELP,
    BackendName,
    backend_of,
    load_run,
    put_on_backend,
    quick_precision,
    to_device,
)
from bodyseg_model.runtimes.onnx_files import Precision
from bodyseg_model.segmentation.files.frame_results import FrameResults, LabelledFrame
from bodyseg_model.segmentation.files.output_folder import IMAGES, LEGEND, PREVIEW, OutputFolder
from bodyseg_model.segmentation.files.write_behind import WriteBehind
from bodyseg_model.segmentation.foreground import Background, BackgroundMode
from bodyseg_model.segmentation.people.person_score import shipped_score
from bodyseg_model.segmentation.pictures.overlay import Preview, draw_parts_legend
from bodyseg_model.segmentation.read_ahead import read_ahead
from bodyseg_model.segmentation.segmenter import FoundSurfaces, Segmenter, Segmenters
from bodyseg_model.segmentation.sequence_summary import SequenceSummary
from bodyseg_model.segmentation.temporal.carried_labels import CarriedLabels
from bodyseg_model.sensor_fit.shadows import ShadowFrames
from bodyseg_model.training.distributed import use_threads

EXAMPLE = "bodyseg segment recording/ --focal 525 --out labelled"

_OF_THE_CARD: Final = ("network", "variant", "seed", "steps", "data", "rig", "sensor", "weights_sha256")
_LABELS, _OVERLAY, _UNDISTORTED = IMAGES
_READ: Final = "read"
_NEAR: Final = 0.7  # of the stand-off; docs/results/segment.md has the accuracy by distance
_SHADOW_FRAMES: Final = 8  # whose shadows tell whether a recording is mirrored


@dataclass(frozen=True)
class Options:
    """Options of `bodyseg segment`."""

    frames: tuple[Path, ...] = option(RECORDINGS_HELP, positional=True)
    out: Path = option("folder for labels, overlays, preview.gif, legend.png and summary.json")
    labels_out: Path | None = option("also write labels with their frames' times into this .mcap file or new bag", None)
    run: Path | None = option("a training's folder, a .safetensors or .onnx file (default: the one that ships)", None)
    backend: BackendName | None = option(BACKEND_HELP, None)
    precision: Precision | None = option(QUICK_PRECISION_HELP, None)
    flip_average: bool = option(FLIP_HELP, False)
    topic: str | None = option("topic of a bag or array of an NPZ file (default: the only one of frames)", None)
    units: str | None = option(UNITS_HELP, None)
    rig: str | None = option(f"frames are from this camera: {', '.join(rig_names())} or a rig file (.toml)", None)
    focal: float | None = option("focal length of the camera, pixels (default: told by the frames' size)", None)
    centre: tuple[float, ...] = option("principal point of the camera, x y (default: the image's middle)", ())
    mirrored: bool = option("frames show left for right, as some drivers give them", False)
    background: BackgroundMode = option(
        "people: keep what is within the limits, on no large plane and of a body's size; limits: keep what is within "
        "them, as one body; keep: keep all that was measured, as one body",
        "people",
    )
    video: bool = option("frames are a video: labels are steadied by those of the frames before", False)
    keep_things: bool = option("label chairs, boxes and other things of a body's size like people", False)
    near: float | None = option("the near limit, metres (default: 0.5)", None)
    far: float | None = option("the far limit, metres (default: 5)", None)
    confidence: float = option("give no label to pixels of less confidence, 0 to 1", 0.0)
    no_overlay: bool = option("write labels and summary alone: no overlay, preview.gif and legend.png", False)
    skip_unreadable: int = option("skip up to this many frames that cannot be read, and list them", 0)
    fps: float = option("frames per second of preview.gif", 10.0)
    ahead: bool = option("find the next frame's surfaces while this one is labelled", False)
    threads: int | None = option("threads that compute the network on the processor (default: all)", None)
    device: str | None = option("cpu, cuda, cuda:1 ... (default: a GPU if there is one)", None)


def run(options: Options) -> int:
    """Label every frame, then write the summary."""
    keep_freed_memory()
    use_threads(options.threads)
    step_m, background = None if options.units is None else metres_a_step(options.units), _background(options)
    frames, skipping = find_frames(options.frames, options.topic, step_m), Skipping(options.skip_unreadable)
    trained = shipped_network() if options.run is None else load_run(options.run)
    precision = options.precision or quick_precision(trained.network, options.backend, options.device)
    trained = put_on_backend(trained, options.backend, precision, options.flip_average)
    label_map = trained.label_map
    preview = None if options.no_overlay else Preview(options.fps, label_map)
    to_device(trained.network, options.device)
    cameras = find_cameras(frames, options.rig, options.focal, options.centre, trained.rig, skipping)
    score = None if options.keep_things else shipped_score()
    video = CarriedLabels() if options.video else None
    segmenters = Segmenters(trained, background, options.mirrored, options.confidence, score, video)
    _, first = segmenters.of(cameras.first.camera)  # now, as nothing is made for options that cannot be
    written = [_LABELS, *([] if options.no_overlay else [_OVERLAY]), *([_UNDISTORTED] if cameras.bent else [])]
    out = OutputFolder(options.out, options.frames, frames, written)
    shape = cameras.first.camera.rows, cameras.first.camera.columns
    results, shadows = FrameResults(out, label_map, preview, shape), ShadowFrames(len(frames), _SHADOW_FRAMES)
    with _labels_out(options, label_map) as messages:
        out.begin()
        first.prepare()
        results.prepare()
        start = time.perf_counter()
        # One thread writes results. If another reads ahead, it alone reads recordings.
        read = (_read(file, cameras, skipping, segmenters, messages is not None) for file in frames)
        with (
            contextlib.closing(read_ahead(read) if options.ahead else read) as coming,
            Progress("segmenting", "frames") as progress,
            WriteBehind() as behind,
        ):
            for number, (file, ready) in enumerate(zip(frames, coming, strict=True)):
                if video is not None and number and file.sequence != frames[number - 1].sequence:
                    video.restart()
                done = partial(progress.update, number + 1, len(frames))
                if ready is None:
                    behind.add(done)
                    continue
                frame = _label(ready)
                if frame.camera is None:
                    shadows.add(number, file.name, frame.range_m, [body.pixels for body in frame.result.bodies])
                if messages is not None:
                    messages.add(file, frame.result.labels, ready.stamp)
                behind.add(partial(_write, frame, results, done))
        seconds = time.perf_counter() - start
    labelled = len(frames) - len(skipping.skipped)
    if preview is not None:
        save_picture(draw_parts_legend(label_map), options.out / LEGEND)
        write_result(options.out / PREVIEW, preview.to_gif())
    summary = results.summary
    facts = {
        "network": {"file": "shipped" if options.run is None else str(options.run), **_facts(trained)},
        "labels": {"name": label_map.name, "classes": [*label_map.names]},
        "camera": {**cameras.to_json(), "mirrored": options.mirrored},
        "unit_m": _units(frames),
        "skipped": skipping.skipped,
        "background": background.to_json(),
        "person_score": None if first.people is None else {"cutoff": first.people.cutoff},
        "resampling": {
            "rig": trained.rig.name,
            "focal_px": trained.rig.camera.focal_px,
            "distance_m": trained.rig.stand_off_m,
            "rule": "each body is scaled so that its median range gets the pixel size of that camera at that distance",
        },
        "least_confidence": options.confidence,
        "video": None if video is None else video.carrying.to_json(),
        "preview": None if preview is None else preview.to_json(),
        "frames_per_second": round(labelled / seconds, 2),
        "hardware": hardware(),
        "device": str(device_of(trained.network)),
        "runtime": backend_of(trained.network),
        "peak_mb": peak_mb(),
    }
    out.finish({**facts, **summary.to_json()})
    lines = _remarks(options, cameras, summary, shadows, skipping, labelled / seconds) + _too_near(summary, trained.rig)
    sys.stderr.write("".join(f"{line}\n" for line in lines))
    return 0


def _units(frames: Sequence[Frame]) -> float | dict[str, float]:
    """Metres in a step: one number, or one for the frames of each file where they differ."""
    of = {str(frame.path): frame.step_m for frame in frames}
    return frames[0].step_m if len(set(of.values())) == 1 else of


def _labels_out(options: Options, label_map: LabelMap) -> contextlib.AbstractContextManager[LabelsOut | None]:
    if options.labels_out is None:
        return contextlib.nullcontext()
    if options.labels_out.resolve().is_relative_to(options.out.resolve()):
        raise BadConfig(f"--labels-out must lie outside --out, found {options.labels_out}")
    return labels_out(options.labels_out, label_map, options.fps)


@dataclass(frozen=True)
class _Ready:
    """A frame that was read, [H, W], and its surfaces. camera: its entry in the summary, where it has one of its own.
    stamp: of its message, where labels go out as messages.
    """

    file: Frame
    pixels: Pixels
    segmenter: Segmenter
    found: FoundSurfaces
    milliseconds: dict[str, float]
    camera: dict[str, Any] | None
    stamp: Stamp | None


def _read(
    file: Frame, cameras: FrameCameras, skipping: Skipping, segmenters: Segmenters, with_stamp: bool
) -> _Ready | None:
    """Read one frame and find its surfaces; None for one that is skipped. Raises BadConfig, naming it."""
    watch = Stopwatch((_READ,))
    with watch(_READ):
        pixels = skipping.read(file)
        if pixels is None:
            return None
        camera = cameras.of(file, (pixels.shape[0], pixels.shape[1]))
        with _naming(file):
            lens, segmenter = segmenters.of(camera.camera)
            if lens is not None:
                pixels = lens(pixels)
            range_m = to_metres(pixels, file.step_m)
    with _naming(file):
        found = segmenter.find(range_m)
    own = camera.to_json() if cameras.is_own(file) else None
    return _Ready(file, pixels, segmenter, found, watch.milliseconds, own, file.stamp() if with_stamp else None)


def _label(ready: _Ready) -> LabelledFrame:
    """Label the surfaces of one frame. Raises BadConfig, naming it."""
    with _naming(ready.file):
        result = ready.segmenter.label(ready.found)
    return LabelledFrame(ready.file, ready.pixels, ready.found.range_m, result, ready.milliseconds, ready.camera)


@contextlib.contextmanager
def _naming(file: Frame) -> Iterator[None]:
    try:
        yield
    except BadConfig as error:
        raise BadConfig(f"{file.where}: {error}") from error


def _write(frame: LabelledFrame, results: FrameResults, done: Callable[[], None]) -> None:
    results.add(frame)
    done()


def _background(options: Options) -> Background:
    limits = {"near_m": options.near, "far_m": options.far}
    given = {name: limit for name, limit in limits.items() if limit is not None}
    if given and options.background == "keep":
        raise BadConfig("--near and --far limit what is kept: they contradict --background keep")
    return Background(options.background, **given)


def _facts(trained: Trained) -> dict[str, Any]:
    """Entries of the network's card that identify it, and how it was trained."""
    return {name: trained.card[name] for name in _OF_THE_CARD if name in trained.card}


def _remarks(
    options: Options,
    cameras: FrameCameras,
    summary: SequenceSummary,
    shadows: ShadowFrames,
    skipping: Skipping,
    per_second: float,
) -> list[str]:
    """Lines for standard error: the results, and warnings about what looks wrong."""
    frames, camera = shadows.frames - len(skipping.skipped), cameras.common or cameras.first
    lines = [
        f"wrote {frames} frames to {options.out}, {rate_text(per_second, 'frames')}, "
        f"{summary.milliseconds['frame']['mean']:.0f} ms from a frame to its labels"
    ]
    if summary.mean_confidence is not None:
        lines[0] += f", {summary.people / frames:.2g} people a frame, mean confidence {summary.mean_confidence:.0%}"
    else:
        lines.append("nobody was found: are --units, --near and --far right?")
    if skipping.skipped:
        lines.append(f"{len(skipping.skipped)} frames could not be read: skipped in summary.json lists them")
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
