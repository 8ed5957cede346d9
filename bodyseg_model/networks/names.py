"""Names of networks, of their files, and of entries in these: what is known without PyTorch."""

from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from bodyseg_data.files import read_json

CheckpointName = Literal["best", "last"]

NETWORKS: Final[dict[str, str]] = {
    "fcn_alexnet": "bodyseg_model.networks.fcn_alexnet.FcnAlexnet",
    "compact": "bodyseg_model.networks.compact.Compact",
}
"""Name -> "package.module.Class", imported when a network of that name is built."""

if TYPE_CHECKING:
    NetworkName = str
else:
    NetworkName = Literal[tuple(NETWORKS)]


class RunFiles:
    """Names of files in a run's folder."""

    NETWORK: Final = "network.safetensors"
    """The trained network; its card is the .json beside it."""

    BEST: Final = "best.safetensors"
    """The weights of the best validation, in the form of `NETWORK`."""

    PLAN: Final = "run.json"

    CHECKPOINT: Final = "checkpoint.json"  # step, loader state and tensors' name of the last checkpoint

    @staticmethod
    def unfinished(folder: Path) -> bool:
        """True if a run's folder has a plan and no network yet, or a checkpoint of a later step than its network's."""
        card = (folder / RunFiles.NETWORK).with_suffix(".json")
        if not card.exists():
            return (folder / RunFiles.PLAN).exists()
        if not (folder / RunFiles.CHECKPOINT).exists():
            return False
        reached, step = read_json(card).get("last_step"), read_json(folder / RunFiles.CHECKPOINT).get("step")
        return isinstance(reached, int) and isinstance(step, int) and reached < step


class CardWords:
    """Words of a network's card that others than this module write or check."""

    FORMAT: Final = "bodyseg network 1"

    WEIGHTS_SHA256: Final = "weights_sha256"
    """Entry: the SHA-256 of the .safetensors file of the weights, in hexadecimal."""

    PRETRAINED: Final = "pretrained"
    """Entry, of a plan too: file and `WEIGHTS_SHA256` of the weights that a training started from; null, or not in a
    plan, for one that started from random weights."""


def confusion_file(path: Path) -> Path:
    """Path of the confusion matrix of a network's scores, beside its weights `path` (.safetensors)."""
    return path.with_suffix(".confusion.json")
