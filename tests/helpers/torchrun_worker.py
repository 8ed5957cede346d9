"""One rank, as torchrun starts it: a few batches of a loader, then trainings; dropout, drawn by each rank, is off.

RANK=R WORLD_SIZE=2 torchrun_worker.py OUT SET BATCHES TRAININGS

This rank's keys and the state of its loader go to files in OUT. TRAININGS: command lines of `bodyseg` as JSON, each
with the port at which its processes meet: [[PORT, [WORD, ...]], ...].
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import torch.distributed
from torch import nn

from bodyseg_data import RangeImages, loader
from bodyseg_model.commands import main


def batches(out: Path, folder: str, count: int) -> None:
    """Write the keys of this rank's first batches, and the loader's state behind them."""
    torch.distributed.init_process_group("gloo")
    rank, world_size = torch.distributed.get_rank(), torch.distributed.get_world_size()
    batches = loader(RangeImages(folder, "all"), 3, num_workers=1, shuffle=True)
    keys = []
    for batch in batches:
        keys.append(batch["key"])
        if len(keys) == count:
            break
    everyone = [None] * world_size
    torch.distributed.all_gather_object(everyone, keys)
    assert everyone[rank] == keys
    (out / f"{rank}-of-{world_size}.json").write_text(json.dumps({"keys": keys, "state": batches.state_dict()}))


def train(port: int, words: list[str]) -> None:
    """Run a training, the first in the loader's process group, others in one that meets at a port of its own."""
    os.environ["MASTER_PORT"] = str(port)
    joined = torch.distributed.is_initialized()
    if main(words) != 0 or torch.distributed.is_initialized() != joined:
        sys.exit(f"failed: {words}")
    if joined:
        torch.distributed.destroy_process_group()


if __name__ == "__main__":
    nn.Dropout.forward = lambda self, x: x  # type: ignore[method-assign]
    batches(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]))
    for port, words in json.loads(sys.argv[4]):
        train(port, words)
