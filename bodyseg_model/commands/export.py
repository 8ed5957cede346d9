"""`bodyseg export`: write a trained network as two small files, weights and card."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from bodyseg_data.commands.options import option
from bodyseg_data.core.errors import BadConfig
from bodyseg_model.networks.checkpoints import (
    WEIGHTS_SHA256,
    confusion_file,
    load_network,
    read_json,
    save_network,
    write_json,
)

EXAMPLE = "bodyseg export --run runs/all-0 --scores scores.json --out compact.safetensors"

_OF_THE_FILE = ("format", "network", "settings", WEIGHTS_SHA256)


@dataclass(frozen=True)
class Options:
    """Options of `bodyseg export`."""

    run: Path = option("a training's folder, or a .safetensors file")
    out: Path = option("the .safetensors file to write; its card goes beside it as .json")
    scores: Path | None = option(
        "figures of `bodyseg evaluate` to put on the card, their confusion matrix in a file beside it", None
    )


def run(options: Options) -> int:
    """Write the network, its filters in 16 bits, and the card."""
    if options.out.suffix != ".safetensors":
        raise BadConfig(f"--out must be a .safetensors file, found {options.out}")
    trained = load_network(options.run)
    facts = {name: value for name, value in trained.card.items() if name not in _OF_THE_FILE}
    confusion = None
    if options.scores is not None:
        facts["scores"] = read_json(options.scores)
        confusion = facts["scores"].pop("confusion", None)
    save_network(options.out, trained.network, trained.card["network"], facts, half=True)
    if confusion is not None:
        write_json(confusion_file(options.out), {"confusion": confusion})
    sys.stderr.write(f"wrote {options.out}, {options.out.stat().st_size / 1e6:.1f} MB\n")
    return 0
