"""The sets and the trainings that results are made from."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Final

from benches.model.ablation.rows import ROWS, Source
from benches.results.step import SHIPPED, Step
from bodyseg_data.artifacts import VARIANTS

SEEDS: Final = 3

OPEN: Final = "sets/open18"
HARD: Final = "sets/hard18"
DRESSED: Final = "sets/dressed233"
BARE: Final = "sets/bare233"
READ: Final = "sets/open200"
KINECT: Final = "sets/kinect"
CANDIDATES: Final = "sets/candidates"
ORDINARY: Final = "sets/wide80"
MAPPED: Final = "sets/open_template"
MAPPED_HARD: Final = "sets/hard_template"
KINECT_HARD: Final = "sets/hard_kinect"
PAPER: Final = "sets/paper"

PLACED_BY: Final = (0, 1)
"""People whose annotations alone place the labels of a training (`bench cross_person`)."""
_PLACED_FROM: Final = {"wide": "100", "everyday": "50"}  # bodies; `wide` has those of `open`, too


def placed_by(person: int) -> dict[str, tuple[str, ...]]:
    """Sets labelled by one person's landmarks, as `SETS`."""
    file = f"tools/benches/model/people/placed_by_{person}.json"
    around = ("--views", "24", "--azimuths", "36", "--azimuth-span", "360")
    return {
        f"sets/placed_by_{person}_{source}": (source, "--landmarks", file, "--meshes", bodies, *around)
        for source, bodies in _PLACED_FROM.items()
    }


SETS: Final = {
    OPEN: ("open",),
    HARD: ("hard",),
    DRESSED: ("open", "--meshes", "233"),
    BARE: ("bare", "--meshes", "233"),
    READ: ("open", "--meshes", "200", "--views", "54"),
    MAPPED: ("open", "--template", "--meshes", "100", "--views", "4"),
    MAPPED_HARD: ("hard", "--template", "--views", "3"),
    KINECT: ("open", "--rig", "kinect_v1", "--meshes", "250", "--views", "12"),
    KINECT_HARD: ("hard", "--rig", "kinect_v1", "--views", "6"),
    PAPER: ("open", "--meshes", "250", "--views", "12"),
    CANDIDATES: ("candidates",),
    ORDINARY: ("wide", "--meshes", "80"),
    **placed_by(0),
    **placed_by(1),
}
"""Folder -> source, and further options of `bodyseg shard`."""

_SHORT: Final = ("--steps", "1400", "--batch-size", "8")
_STILL: Final = "--no-geometric-augmentation"
_HOW: Final = ("--threads", "1", "--num-workers", "1", "--checkpoint-every", "250", "--log-every", "50", "--resume")

_ALEXNET: Final = ("--network", "fcn_alexnet", "--recipe", "compact")

NETWORKS: Final = {
    "compact_half": ("--settings", '{"shrink":2,"patch":8}'),
    "compact_quarter": ("--settings", '{"shrink":4,"patch":4}'),
    "compact_small": ("--settings", '{"widths":[64,80,96],"blocks":[1,1,1]}'),
    "compact_fine": ("--settings", '{"patch":8,"widths":[48,96,128,144],"blocks":[1,2,2,1]}'),
    "compact_large": ("--settings", '{"widths":[160,208,240],"blocks":[3,3,2]}'),
    "deeplab_half": ("--network", "deeplab", "--recipe", "compact", "--settings", '{"shrink":2}'),
    "fcn_alexnet_8th": (*_ALEXNET, "--settings", '{"width":0.125}'),
    "fcn_alexnet_4th": (*_ALEXNET, "--settings", '{"width":0.25}'),
}
"""Row of the table of networks, which `compact` heads -> options of its trainings."""

BOX: Final = "runs/box"
BOX_LINKS: Final = ((BOX, SHIPPED),)
"""The network that ships, as a run."""

_TINY: Final = ("--settings", '{"widths":[56,72,80],"blocks":[1,1,1]}')  # half a million parameters
SMALLER: Final = {"compact_tiny": _TINY}
"""Row of the table of smaller networks -> options of its trainings."""

_SEEDS_OF_ROWS: Final = {"no_occlusion": SEEDS, "no_noise": SEEDS, "losses": SEEDS}
_ROWS_OF_NETWORKS: Final = {"half_resolution": "compact_half", "quarter_resolution": "compact_quarter"}
_SETS_OF_ROWS: Final[dict[Source, str]] = {"": OPEN, "dressed": DRESSED, "bare": BARE}

Links = tuple[tuple[str, str], ...]


def seeds(name: str) -> tuple[str, ...]:
    """NAME-0, NAME-1 ..."""
    return tuple(f"{name}-{seed}" for seed in range(SEEDS))


FITTED: Final = "tools/benches/model/variants/kinect_v1_fitted.toml"
"""What `bodyseg sensor fit` makes of the real Kinect's frames."""

OTHER_RUNS: Final = {
    "sensor": ("--sensor", "kinect_v1"),
    "phase_shift": ("--sensor", "paper_phase_shift"),
    "fitted": ("--sensor", FITTED),
    "losses": ("--losses", "0.3"),
    "mixture": ("--sensor", "paper", "kinect_v1", "realsense_d435", "azure_kinect"),
}
"""Trainings beside the five variants -> their options."""

FULL_RUNS: Final = tuple(itertools.chain(*(seeds(f"runs/full/{variant}") for variant in VARIANTS)))
"""Fifteen trainings of the whole `compact`: five variants, three seeds, of a rig of which there are real frames."""

_LONG: Final = ("--steps", "1000", "--batch-size", "32", "--bust", "0.5")
"""32 000 images from random weights, half of them upper bodies, as most real frames show: the artifacts alone differ
from the first step on, and so long a training needs no start that others share.
"""

_FINE: Final = ("--settings", '{"patch":4,"widths":[16,32,56,72,80],"blocks":[0,1,1,1,1]}')
"""Of a network whose first layer sees 4 x 4 pixels."""

REFERENCE_RUNS: Final = seeds("runs/alexnet/fcn_alexnet_8th_none")
"""The networks that mCE compares with."""

PAPER_RUNS: Final = (*seeds("runs/paper/none"), *seeds("runs/paper/all"))
"""Trainings of the whole `compact` for the paper's rig."""

ALEXNET_RUNS: Final = ("runs/paper_alexnet/none-0", "runs/paper_alexnet/all-0")
"""The same of the paper's network, a quarter of its width."""

PLACED_RUNS: Final = tuple(f"runs/placed_by-{person}" for person in PLACED_BY)
"""Trainings on the labels of `PLACED_BY`."""

NETWORK_RUNS: Final = tuple(itertools.chain(*(seeds(f"runs/networks/{name}") for name in ("compact", *NETWORKS))))

SMALLER_LINKS: Final[Links] = (
    *zip(seeds("runs/smaller/compact"), seeds("runs/networks/compact"), strict=True),
    *zip(seeds("runs/smaller/compact_small"), seeds("runs/networks/compact_small"), strict=True),
)

ABLATION_LINKS: Final[Links] = (
    *zip(seeds("runs/ablation/all"), seeds("runs/networks/compact"), strict=True),
    *(
        pair
        for row, name in _ROWS_OF_NETWORKS.items()
        for pair in zip(seeds(f"runs/ablation/{row}"), seeds(f"runs/networks/{name}"), strict=True)
    ),
)


def sets() -> Iterator[Step]:
    """Steps that pack sets, of 18 views a body where their options name no other number."""
    for name, (source, *more) in SETS.items():
        views = () if "--views" in more else ("--views", "18")
        yield Step(name, "set", ("bodyseg", "shard", "--source", source, *more, *views, "--out", name))


def trainings() -> Iterator[Step]:
    """Steps that train, in an order in which the results that need few trainings come first."""
    rows: dict[str, tuple[str, ...]] = {variant: ("--variant", variant) for variant in VARIANTS}
    either = {name: rows[name] for name in ("none", "all")}
    rows |= OTHER_RUNS
    for (name, artifacts), seed in itertools.product(rows.items(), range(SEEDS)):
        yield _training(f"runs/full/{name}-{seed}", KINECT, *artifacts, seed=seed, scale=_LONG)
    for folder, network, count in (("runs/paper", (), SEEDS), ("runs/paper_alexnet", NETWORKS["fcn_alexnet_4th"], 2)):
        for (name, artifacts), seed in itertools.product(either.items(), range(count)):
            yield _training(f"{folder}/{name}-{seed}", PAPER, *artifacts, *network, seed=seed, scale=_LONG)
    for variant, seed in itertools.product(("none", "noise"), range(2)):
        yield _training(f"runs/fine/{variant}-{seed}", KINECT, *rows[variant], *_FINE, seed=seed, scale=_LONG)
    long = ("--losses", "0.3", "--ema", "0.999", "--lr", "0.003", "--steps", "1000", "--batch-size", "64")
    for person, run in zip(PLACED_BY, PLACED_RUNS, strict=True):
        yield Step(run, "training", ("bodyseg", "train", "--data", *placed_by(person), "--out", run, *long, *_HOW))
    for (name, options), seed in itertools.product([("compact", ()), *NETWORKS.items()], range(SEEDS)):
        yield _training(f"runs/networks/{name}-{seed}", OPEN, *options, seed=seed)
    for (name, options), seed in itertools.product(SMALLER.items(), range(SEEDS)):
        yield _training(f"runs/smaller/{name}-{seed}", OPEN, *options, seed=seed)
    for seed, run in enumerate(REFERENCE_RUNS):
        yield _training(run, OPEN, "--variant", "none", *NETWORKS["fcn_alexnet_8th"], seed=seed)
    for row in ROWS:
        if row.arguments is None or row.name in _ROWS_OF_NETWORKS:
            continue
        for seed in range(_SEEDS_OF_ROWS.get(row.name, 1)):
            yield _training(f"runs/ablation/{row.name}-{seed}", _SETS_OF_ROWS[row.source], *row.arguments, seed=seed)


def _training(name: str, data: str, *options: str, seed: int, scale: tuple[str, ...] = (*_SHORT, _STILL)) -> Step:
    chosen = (*options, *(("--seed", str(seed)) if seed else ()))
    words = ("bodyseg", "train", "--data", data, "--out", name, *scale, *chosen, *_HOW)
    return Step(name, "training", words)
