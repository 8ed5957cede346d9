"""What torchrun starts: a few batches of this rank, and where it stands then, written to a file.

torchrun --nproc-per-node=2 rank_worker.py OUT SET BATCHES
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import torch.distributed

from bodyseg_data import RangeImages, loader


def main(out: Path, folder: str, count: int) -> None:
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
    torch.distributed.destroy_process_group()


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]))
