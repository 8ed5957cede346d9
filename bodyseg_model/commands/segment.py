"""`bodyseg segment`: find the parts of people in frames of a range sensor."""

from __future__ import annotations

import contextlib
import sys
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from bodyseg_data import load_template
from bodyseg_data.commands import Progress, option, rate_text
from bodyseg_data.core import BadConfig
from bodyseg_data.labels import LabelMap
from bodyseg_data.machine import hardware, keep_freed_memory
from bodyseg_data.rigs import rig_names
from bodyseg_model import recordings, runtimes, segmentation, sensor_fit, training

EXAMPLE = "bodyseg segment recording/ --focal 525 --out labelled"

_OF_THE_CARD: Final = ("network", "variant", "seed", "steps", "data", "sensor", "weights_sha256")  # identify it
_NEAR: Final = 0.7  # share of the stand-off below which there is a warning (docs/results/segment.md)
_SURE: Final = 0.8  # mean confidence; below it, other turns of frames are tried
_AT_ONCE: Final = 4  # most frames at a time: Python itself takes a fourth of a frame's time, and runs in one at a time
_SHADOW_FRAMES: Final = 8  # number of frames whose shadows tell whether a recording is mirrored


@dataclass(frozen=True)
class Options:
    frames: tuple[Path, ...] = option(recordings.RECORDINGS_HELP, positional=True)
    out: Path = option("folder that gets labels, persons, overlays, preview.gif, legend.png and summary.json")
    labels_out: Path | None = option("also write labels with their frames' times into this .mcap file", None)
    points: bool = option("with --labels-out: also write the points of people, with label and confidence", False)
    run: Path | None = option(runtimes.RUN_HELP, None, heading="Network")
    backend: runtimes.BackendName | None = option(runtimes.BACKEND_HELP, None)
    precision: runtimes.Precision | None = option(runtimes.QUICK_PRECISION_HELP, None)
    flip_average: bool = option(runtimes.FLIP_HELP, False)
    labels: str | None = option(
        "classes to give, joined from the network's: a label map, such as limbs14 (default: the network's)", None
    )
    topic: str | None = option(
        "topic of a bag or array of an NPZ file (default: the only one of frames)", None, heading="Frames and camera"
    )
    units: str | None = option(recordings.UNITS_HELP, None)
    rig: str | None = option(f"camera of the frames: {', '.join(rig_names())} or a rig file (.toml)", None)
    focal: float | None = option(recordings.FOCAL_HELP, None)
    centre: tuple[float, ...] = option(recordings.CENTRE_HELP, ())
    mirrored: bool = option("frames show left for right, as some drivers give them", False)
    turned: segmentation.Turned | None = option(f"{segmentation.TURNED_HELP} (default: the rig's roll)", None)
    background: segmentation.BackgroundMode | None = option(
        "what is labelled; people: those found from --near to --far; limits: all from --near to --far, as one body; "
        "keep: all that was measured, as one body; frame: the whole frame as it stands (default: people, or frame for "
        "a network of other classes than body parts)",
        None,
        heading="People",
    )
    video: bool = option("frames are a video: steady labels by those of the frames before", False)
    finder: Path | None = option(
        "network that finds people: a training's folder or a file (default: the one that ships)", None
    )
    dense: bool = option("also write where on the body's template each pixel lies, 16-bit PNGs (65535: none)", False)
    keep_things: bool = option("also label what the finder takes for people and the network doubts", False)
    near: float | None = option("with people or limits: what is nearer is background, metres (default: 0.4)", None)
    far: float | None = option("with people or limits: what is farther is background, metres (default: 6)", None)
    confidence: float = option("leave pixels of less confidence than this, 0 to 1, without a label", 0.0)
    no_overlay: bool = option(
        "write labels, persons and summary alone: no overlay, preview.gif, legend.png", False, heading="Output"
    )
    skip_unreadable: int = option(
        "skip up to this many frames that cannot be read, or recordings that cannot be opened (exit status 1); "
        "summary.json lists them",
        0,
    )
    fps: float = option("frames a second of preview.gif, and of --labels-out where frames have no times", 10.0)
    threads: int | None = option(runtimes.THREADS_HELP, None, heading="Machine")
    device: str | None = option(runtimes.DEVICE_HELP, None)


def run(options: Options) -> int:
    """Label every frame, then write the summary."""
    with contextlib.ExitStack() as claim:  # until the summary is written
        return _segment(options, claim)


def _segment(options: Options, claim: contextlib.ExitStack) -> int:
    keep_freed_memory()
    step_m = None if options.units is None else recordings.metres_a_step(options.units)
    frames = recordings.find_frames(options.frames, options.topic, step_m, options.skip_unreadable)
    threads = training.use_threads(options.threads)
    at_once = 1 if options.video else min(threads, _AT_ONCE, len(frames))
    training.use_threads(threads // at_once)
    trained = runtimes.load_network(options.run, dense=options.dense)
    mode = options.background or segmentation.Background.usual(trained.label_map).mode
    background = segmentation.Background.of_options(mode, options.near, options.far)
    labeller = segmentation.FrameLabeller(
        trained,
        background,
        mirrored=options.mirrored,
        least_confidence=options.confidence,
        keep_things=options.keep_things,
        finder=None if options.finder is None else runtimes.load_network(options.finder),
        video=options.video,
        backend=options.backend,
        precision=options.precision or runtimes.quick_precision(trained.network, options.backend, options.device),
        flip_average=options.flip_average,
        device=options.device,
        turned=options.turned,
        dense=options.dense,
        labels=options.labels,
    )
    # Checks the rate, which labels without times have, too.
    animation = segmentation.Preview(options.fps, labeller.label_map)
    preview = None if options.no_overlay else animation
    recording = labeller.recording(
        frames,
        rig=options.rig,
        focal_px=options.focal,
        centre_px=options.centre,
        skip_unreadable=options.skip_unreadable,
    )
    cameras = recording.cameras
    written = {
        segmentation.ImageKind.LABELS: True,
        segmentation.ImageKind.PERSONS: labeller.label_map.of_bodies,
        segmentation.ImageKind.OVERLAY: not options.no_overlay,
        segmentation.ImageKind.UNDISTORTED: cameras.bent,
        segmentation.ImageKind.TEMPLATE: options.dense,
    }
    shape = cameras.first.camera.rows, cameras.first.camera.columns
    out = segmentation.OutputFolder(
        options.out, options.frames, frames, [kind for kind, wanted in written.items() if wanted]
    )
    results = segmentation.FrameResults(out, labeller.label_map, preview, shape)
    shadows = sensor_fit.ShadowFrames(len(frames), _SHADOW_FRAMES)
    with _labels_out(options, labeller.label_map) as messages:
        claim.enter_context(out.claimed())
        results.begin()
        recording.prepare()
        start = time.perf_counter()
        # One thread writes results, and one alone reads recordings.
        with (
            contextlib.closing(recording.labelled(at_once, stamps=messages is not None)) as coming,
            Progress("segmenting", "frames") as progress,
            results,
        ):
            done = 0
            for labelled in coming:
                frame = frames[labelled.number]
                if labelled.own_camera is None:
                    shadows.add(labelled)
                if messages is not None:
                    points = labelled.points() if options.points else None
                    messages.add(frame, labelled.labels, labelled.stamp, points)
                done = labelled.number + 1
                results.add(labelled, frame, partial(progress.update, done, len(frames)))
            if done < len(frames):  # the last ones are skipped
                results.then(partial(progress.update, len(frames), len(frames)))
        seconds = time.perf_counter() - start
    per_second = (len(frames) - len(recording.skipped)) / seconds
    results.finish(
        {
            "network": {
                "file": "shipped" if options.run is None else str(options.run),
                **{name: trained.card[name] for name in _OF_THE_CARD if name in trained.card},
            },
            "labels": labeller.label_map.to_json(),
            **({"template": load_template().name} if options.dense else {}),
            **recording.to_json(),
            **({} if step_m is None else {"given_unit_m": step_m}),
            **labeller.to_json(),
            "frames_per_second": round(per_second, 2),
            "hardware": hardware(),
        }
    )
    lines = _remarks(options, recording, results.summary, shadows, per_second)
    unopened = [frame.where for frame in frames if not frame.source.opened]
    lines += [f"skipped {frame['error']}" for frame in recording.skipped if frame["file"] in unopened]
    sys.stderr.write("".join(f"{line}\n" for line in lines))
    return 1 if unopened else 0


def _labels_out(
    options: Options, label_map: LabelMap
) -> contextlib.AbstractContextManager[recordings.LabelsOut | None]:
    if options.labels_out is None:
        if options.points:
            raise BadConfig("--points are written beside labels: give --labels-out, too")
        return contextlib.nullcontext()
    if any(options.labels_out.resolve().is_relative_to(each.resolve()) for each in (options.out, *options.frames)):
        raise BadConfig(f"--labels-out must lie outside --out and the frames, found {options.labels_out}")
    return recordings.labels_out(options.labels_out, label_map, options.fps)


def _remarks(
    options: Options,
    recording: segmentation.LabelledRecording,
    summary: segmentation.SequenceSummary,
    shadows: sensor_fit.ShadowFrames,
    per_second: float,
) -> list[str]:
    """Lines for standard error: the results, and warnings about what looks wrong."""
    frames, camera = len(recording) - len(recording.skipped), recording.cameras.common or recording.cameras.first
    lines = [
        f"wrote {frames} frames to {options.out}, {rate_text(per_second, 'frames')}, "
        f"{summary.milliseconds['frame']['mean']:.0f} ms from a frame to its labels"
    ]
    background = recording.labeller.background.mode
    if background == "frame":
        lines[0] += f", mean confidence {summary.mean_confidence or 0:.0%}"
    elif summary.mean_confidence is not None:
        people = f"{summary.people / frames:.2g}"
        lines[0] += f", {people} {'person' if people == '1' else 'people'} a frame"
        lines[0] += f", mean confidence {summary.mean_confidence:.0%}"
    else:
        lines.append(
            f"nobody was found: are --units, --near and --far right? The camera is {camera.origin}, focal length "
            f"{camera.camera.focal_px:.5g} px: are --focal, --rig and --turned right?"
        )
    if recording.skipped:
        count = len(recording.skipped)
        lines.append(f"{count} frame{'s' * (count > 1)} could not be read: see skipped in summary.json")
    if summary.doubted:
        lines.append(
            f"{summary.doubted / frames:.2g} things a frame that look like people got no label, as the network doubts "
            "them: --keep-things labels them, too"
        )
    # Without people, 0 if there were things that the network doubted, else 1.
    sure = summary.mean_confidence or float(not summary.doubted)
    if options.turned == "auto":
        lines.append(f"--turned auto: {recording.turned_deg}{'' if summary.people else ', as no frame tells'}")
    elif options.turned is None and background != "frame" and sure < _SURE:
        turned = recording.surer_turn_deg()
        if turned is not None:
            lines.append(f"the network is surer of people when frames are turned: give --turned {turned} if they are")
    if camera.assumed:
        lines.append(f"camera {camera.origin}: give --focal or --rig if it is another")
    if background == "frame":  # what follows is about bodies
        own, its = (
            f"{of.rows} x {of.columns} with a focal length of {of.focal_px:.3g} px"
            for of in (camera.camera, recording.labeller.rig.camera)
        )
        if own != its:
            lines.append(f"frames are {own}, those that the network was trained on {its}: labels are less accurate")
        return lines
    mirrored = shadows.mirrored(camera)
    if mirrored is not None and mirrored != options.mirrored:
        shown = "mirrored: give" if mirrored else "not mirrored: leave out"
        lines.append(
            f"the projector's shadows lie on the {camera.projector_side if mirrored else 'other'} side of bodies, so "
            f"frames are probably {shown} --mirrored"
        )
    range_m, rig = summary.median_range_m, recording.labeller.rig
    if range_m is not None and range_m < _NEAR * rig.stand_off_m:  # resampling does not correct so near a perspective
        lines.append(
            f"bodies are {range_m:.2g} m away, the network was trained for {rig.stand_off_m:.2g} m (rig {rig.name}): "
            "so near, labels are less accurate"
        )
    return lines
