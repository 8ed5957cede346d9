"""`bodyseg export`: write a trained network as two small files, weights and card, or as one ONNX file."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bodyseg_data.commands import check_target, option
from bodyseg_data.core import BadConfig
from bodyseg_data.files import read_json, write_json
from bodyseg_model import networks, runtimes
from bodyseg_model.networks import CardWords, RunFiles

EXAMPLE = "bodyseg export --run runs/all-0 --scores scores.json --out compact.safetensors"

_OF_THE_FILE = ("format", "network", "settings", CardWords.WEIGHTS_SHA256)


@dataclass(frozen=True)
class Options:
    run: Path | None = option("network: 'large', a training's folder or a .safetensors file (default: compact)", None)
    out: Path | None = option("write this .safetensors file, and its card beside it as .json; or give --onnx", None)
    onnx: Path | None = option("write this .onnx file, which turns range images into labels and confidences", None)
    scores: Path | None = option(
        "scores for the card, of `evaluate --json`; their confusion matrix goes into a file beside it", None
    )


def run(options: Options) -> int:
    """Write the network, its filters in 16 bits, and the card; and the ONNX file."""
    if options.out is None and options.onnx is None:
        raise BadConfig("give the file to write: --out FILE.safetensors or --onnx FILE.onnx")
    for flag, path, suffix in (("--out", options.out, ".safetensors"), ("--onnx", options.onnx, runtimes.SUFFIX)):
        if path is not None and path.suffix != suffix:
            raise BadConfig(f"{flag} must be a {suffix} file, found {path}")
        if path is not None:
            check_target(path, flag)
            if path.name in (RunFiles.NETWORK, RunFiles.BEST) and path.with_name(RunFiles.PLAN).exists():
                raise BadConfig(f"{flag} must not replace the weights of a training, of 32 bits, found {path}")
    trained = networks.load_network(options.run)
    scores, confusion = dict[str, Any](), None
    if options.scores is not None:
        figures = read_json(options.scores)
        card = figures.get("card")
        if not isinstance(card, dict) or card.get(CardWords.WEIGHTS_SHA256) != trained.card[CardWords.WEIGHTS_SHA256]:
            of = options.run or "compact"
            raise BadConfig(f"--scores must be what bodyseg evaluate --json wrote of {of}, found {options.scores}")
        confusion, scores = figures.pop("confusion", None), {"scores": figures}
    if options.onnx is not None:
        size = runtimes.write_onnx(options.onnx, networks.Trained(trained.network, {**trained.card, **scores}))
        sys.stderr.write(f"wrote {options.onnx}, {size / 1e6:.1f} MB, opset {runtimes.OPSET}\n")
    if options.out is not None:
        facts = {name: value for name, value in trained.card.items() if name not in _OF_THE_FILE}
        networks.save_network(options.out, trained.network, trained.card["network"], {**facts, **scores}, half=True)
        if confusion is not None:
            write_json(networks.confusion_file(options.out), {"confusion": confusion})
        elif options.run is None or options.run.resolve() != options.out.resolve():
            networks.confusion_file(options.out).unlink(missing_ok=True)  # of the network that was there
        sys.stderr.write(f"wrote {options.out}, {options.out.stat().st_size / 1e6:.1f} MB\n")
    return 0
