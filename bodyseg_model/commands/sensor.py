"""`bodyseg sensor`: measure the artifacts of a sensor from its own frames of people; show sensor models."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path

from bodyseg_data.artifacts import SensorModel, load_sensor_model, sensor_model_names
from bodyseg_data.commands import Progress, check_target, option
from bodyseg_data.core import BadConfig
from bodyseg_data.drawing import check_picture, save_picture
from bodyseg_data.files import write_result
from bodyseg_data.rigs import load_rig, rig_names
from bodyseg_model import recordings, segmentation, sensor_fit, training

EXAMPLE = "bodyseg sensor fit recording/ --focal 525 --nearer-than 1.2 --out sensor.toml"


@dataclass(frozen=True)
class Options:
    frames: tuple[Path, ...] = option(recordings.RECORDINGS_HELP, positional=True)
    out: Path | None = option("write the sensor model to this .toml file", None)
    picture: Path | None = option("draw a frame beside its simulation into this PNG file", None)
    json: bool = option("print all figures as JSON, in place of the table of verdicts", False)
    name: str = option("name for the sensor model, one word", "measured")
    topic: str | None = option("topic of a bag or array of an NPZ file (default: the only one of frames)", None)
    units: str | None = option(recordings.UNITS_HELP, None)
    rig: str | None = option(f"sensor of the frames: {', '.join(rig_names())} or a rig file (.toml)", None)
    focal: float | None = option(recordings.FOCAL_HELP, None)
    centre: tuple[float, ...] = option(recordings.CENTRE_HELP, ())
    turned: segmentation.Turned | None = option(f"{segmentation.TURNED_HELP} (default: the rig's roll)", None)
    background: segmentation.BackgroundMode = option(
        "what is a body; people: as segment finds them; limits: all from --near to --far; keep, frame: all measured",
        "people",
    )
    skip_unreadable: int = option("skip up to this many frames that cannot be read, or recordings that do not open", 0)
    near: float | None = option("with people or limits: what is nearer is background, metres (default: 0.4)", None)
    far: float | None = option("with people or limits: what is farther is background, metres (default: 6)", None)
    nearer_than: float | None = option("body of any size: all nearer than this, metres; not with --background", None)


def run(options: Options) -> int:
    """Measure a sensor, print the verdicts, and write what was asked for."""
    for path, flag in ((options.out, "--out"), (options.picture, "--picture")):
        if path is not None:
            check_target(path, flag)
    if options.out is not None and options.out.suffix.lower() != ".toml":
        raise BadConfig(f"--out must be a .toml file, found {options.out}")
    if options.picture is not None:
        check_picture(options.picture, "--picture")
        held = recordings.open_recording(options.picture) if options.picture.is_file() else ()
        if any(recordings.Skipping(1).read(frame) is not None for frame in held):  # as of `--picture *.png`
            raise BadConfig(f"--picture must not replace a frame, found {options.picture}: name it behind the frames")
    SensorModel(options.name)  # a bad name is told before the measurement
    step_m = None if options.units is None else recordings.metres_a_step(options.units)
    skipping = recordings.Skipping(options.skip_unreadable)
    files = recordings.find_frames(options.frames, options.topic, step_m, skipping.budget)
    training.use_threads(None)
    background = _background(options)
    camera = recordings.FrameCameras(files, options.rig, options.focal, options.centre, load_rig(), skipping).first
    quarters = _quarters(options, files, background, camera)
    recording = sensor_fit.read_recording(files, camera.camera, background, options.nearer_than, skipping, quarters)
    with Progress("measuring", "steps") as progress:
        fit = sensor_fit.fit_sensor(recording, camera, progress.update)
    model = fit.model(options.name)
    if options.json:
        sys.stdout.write(json.dumps({**fit.to_json(), "sensor": model.to_json()}, indent=1) + "\n")
    else:
        artifact, verdict = (max(len(vars(each)[name]) for each in fit.findings) for name in ("artifact", "verdict"))
        for each in fit.findings:
            sys.stdout.write(f"{each.artifact:{artifact}}  {each.verdict:{verdict}}  {each.reason}\n")
    if options.out is not None:
        write_result(options.out, model.to_toml(fit.comments()).encode())
        sys.stderr.write(f"wrote {options.out}\n")
    if options.picture is not None:
        save_picture(sensor_fit.draw_comparison(recording, model), options.picture)
        sys.stderr.write(f"wrote {options.picture}\n")
    if not model.artifacts:
        unknown = sum(each.verdict == "cannot be told" for each in fit.findings)
        found = f"{unknown} of {len(fit.findings)} cannot be told: record somebody who stands still before a wall"
        sys.stderr.write(f"the model has no artifact and leaves images clean; {found}\n")
    if fit.mirrored:
        sys.stderr.write("frames are probably mirrored: give --mirrored to bodyseg segment\n")
    if camera.assumed:
        sys.stderr.write(f"camera {camera.origin}: give --focal or --rig if it is another\n")
    sys.stderr.write("".join(f"skipped {frame['error']}\n" for frame in skipping.skipped))
    return 0


def _quarters(
    options: Options, files: list[recordings.Frame], background: segmentation.Background, camera: recordings.FrameCamera
) -> int:
    """Right angles by which frames are turned clockwise, as `bodyseg segment` turns them."""
    if options.turned != "auto":
        return round(camera.camera.roll_deg / 90) if options.turned is None else int(options.turned) // 90
    labeller = segmentation.FrameLabeller(background=background, turned="auto")
    found = labeller.recording(
        files,
        rig=options.rig,
        focal_px=options.focal,
        centre_px=options.centre,
        skip_unreadable=options.skip_unreadable,
    )
    return found.turned_deg // 90


def _background(options: Options) -> segmentation.Background:
    found = segmentation.Background.of_options(options.background, options.near, options.far)
    if options.nearer_than is not None and found != segmentation.Background():
        raise BadConfig("--nearer-than finds bodies alone: leave out --background, --near and --far")
    if options.nearer_than is not None and not options.nearer_than > 0:
        raise BadConfig(f"--nearer-than must be above 0 m, found {options.nearer_than:g}")
    return found


class ShowSensor:
    EXAMPLE = "bodyseg sensor show kinect_v1"

    @dataclass(frozen=True)
    class Options:
        sensor: str = option(f"one of {', '.join(sensor_model_names())}, or a TOML file", positional=True, address=True)

    @staticmethod
    def run(options: Options) -> int:
        """Print the model with every strength, those left out in the file at their defaults."""
        sys.stdout.write(load_sensor_model(options.sensor).to_toml())
        return 0
