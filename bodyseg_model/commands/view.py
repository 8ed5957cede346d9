"""`bodyseg view`: a set or a recording in the browser."""

from __future__ import annotations

import sys
import threading
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

from bodyseg_data.artifacts import PAPER_SENSOR, VariantName, load_sensor_model
from bodyseg_data.commands import WHERE_HELP, flag_of, headings, option
from bodyseg_data.core import BadConfig
from bodyseg_data.labels import label_map_names
from bodyseg_data.rigs import rig_names
from bodyseg_data.samples import ReadSplit
from bodyseg_data.shards import MANIFEST_NAME
from bodyseg_model import networks, runtimes, segmentation, training, viewing
from bodyseg_model.recordings import CENTRE_HELP, FOCAL_HELP, UNITS_HELP, find_frames, metres_a_step

EXAMPLE = "bodyseg view shards"


@dataclass(frozen=True)
class Options:
    """Options of `bodyseg view`: those for one kind of source stand under its heading, "Sets" or "Frames"."""

    source: tuple[str, ...] = option(
        "folder or address of a set of shards; or frames as `segment` reads them", positional=True, address=True
    )
    run: Path | None = option("network: 'large', a training's folder or a .safetensors file (default: compact)", None)
    host: str = option("address to serve on; any but loopback lets other machines in", viewing.LOOPBACK)
    allow_host: tuple[str, ...] = option("further names of hosts to answer under, such as a proxy's", ())
    port: int = option("port to serve on, or the next free one", 8080)
    save: Path | None = option("folder that gets saved pictures (default: the browser downloads them)", None)
    device: str | None = option(runtimes.DEVICE_HELP, None)
    split: ReadSplit | None = option("split to show (default: train and test)", None, heading="Sets")
    val_share: float = option("share of the train split that counts as val, not as train", 0.0)
    where: tuple[str, ...] = option(WHERE_HELP, ())
    only: tuple[str, ...] = option("show only samples whose key matches one of these patterns, like 'open-A-*'", ())
    labels: str | None = option(
        f"classes to show: {', '.join(label_map_names())} or a label map (.toml) (default: the network's)", None
    )
    variant: VariantName = option("artifacts that images have at first; the page changes them", "all")
    sensor: str = option("sensor model with the artifacts: the name of one that ships, or a TOML file", PAPER_SENSOR)
    seed: int = option("seed of the artifacts", 0)
    topic: str | None = option(
        "topic of a bag or array of an NPZ file (default: the only one of frames)", None, heading="Frames"
    )
    units: str | None = option(UNITS_HELP, None)
    rig: str | None = option(f"camera of the frames: {', '.join(rig_names())} or a rig file (.toml)", None)
    focal: float | None = option(FOCAL_HELP, None)
    centre: tuple[float, ...] = option(CENTRE_HELP, ())
    mirrored: bool = option("frames show left for right, as some drivers give them", False)
    turned: segmentation.Turned | None = option(f"{segmentation.TURNED_HELP} (default: the rig's roll)", None)
    background: segmentation.BackgroundMode | None = option("what is labelled, as for `segment`", None)
    keep_things: bool = option("also label what the finder takes for people and the network doubts", False)
    confidence: float = option("leave pixels of less confidence than this, 0 to 1, without a label", 0.0)


def run(options: Options) -> int:
    """Serve the page until Ctrl-C."""
    kind = "set" if is_set(options.source) else "recording"
    check_options(options, kind)
    if options.save is not None and not options.save.is_dir():
        raise BadConfig(f"--save must be a folder that is there, found {options.save}")
    training.use_threads(None)
    trained = networks.load_network(options.run)
    trained.network.to(networks.find_device(options.device))
    view: viewing.SetView | viewing.RecordingView
    if kind == "set":
        chosen = options.split, options.only, options.where, options.val_share, options.seed, options.labels
        view = plain = viewing.SetView(options.source[0], None, *chosen)
        if options.run is not None or plain.images.manifest.classes == trained.label_map.of:  # the shipped one's
            view = viewing.SetView(options.source[0], trained, *chosen)
    else:
        view = _recording_view(options, trained)
    index = view.first_index() if isinstance(view, viewing.SetView) else 0
    first = viewing.Shown(index, options.variant, sensor=load_sensor_model(options.sensor))
    page, recording = viewing.Page(options.host, options.port, "bodyseg view", options.save, options.allow_host), None
    try:
        if isinstance(view, viewing.SetView):
            viewing.SetPage(page, view, first)
        else:
            recording = viewing.RecordingPage(page, view)
        sys.stderr.write(f"{welcome(page.address, options.host, page.port)}\n")
        sys.stderr.flush()
        threading.Event().wait()
    finally:
        if recording is not None:
            recording.close()
        page.close()
    return 0


def welcome(address: str, host: str, port: int) -> str:
    """The line that says where the page is, and who can reach it."""
    if host in ("localhost", "::1") or host.startswith("127."):
        return f"open {address} in a browser; Ctrl-C ends"
    everyone = f"whoever has this address and reaches port {port} of this machine sees the page and saves pictures"
    return f"open {address} in a browser; {everyone}; Ctrl-C ends"


def is_set(source: Sequence[str]) -> bool:
    """True for the address of a set, a folder with a manifest or shards of one. Raises BadConfig for several sets."""
    found = [
        "://" in each
        or (Path(each) / MANIFEST_NAME).is_file()
        or (not Path(each).is_dir() and Path(each).with_name(MANIFEST_NAME).is_file())
        for each in source
    ]
    if any(found) and len(source) > 1:
        raise BadConfig(f"view shows one set, or one or several recordings, found {' '.join(source)}")
    return any(found)


def check_options(options: Options, kind: str) -> None:
    """Raise BadConfig for an option that a set or a recording does not have, so that none is given in vain."""
    above, other = headings(Options), "Frames" if kind == "set" else "Sets"
    for field in fields(options):
        if above[field.name] == other and getattr(options, field.name) != field.default:
            raise BadConfig(f"{flag_of(field)} is for {other.lower()}, found it with a {kind}")


def _recording_view(options: Options, trained: networks.Trained) -> viewing.RecordingView:
    step_m = None if options.units is None else metres_a_step(options.units)
    paths = [Path(each) for each in options.source]
    try:
        frames = find_frames(paths, options.topic, step_m)
    except BadConfig as error:
        if not all(path.is_dir() for path in paths):
            raise
        raise BadConfig(f"{error}; a set of shards has {MANIFEST_NAME}, which is written last") from error
    labeller = segmentation.FrameLabeller(
        trained,
        None if options.background is None else segmentation.Background(options.background),
        mirrored=options.mirrored,
        least_confidence=options.confidence,
        keep_things=options.keep_things,
        device=options.device,
        turned=options.turned,
    )
    return viewing.RecordingView(
        labeller.recording(frames, rig=options.rig, focal_px=options.focal, centre_px=options.centre)
    )
