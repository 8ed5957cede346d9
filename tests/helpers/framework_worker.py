"""Program that torchrun starts on two ranks: the keys of an epoch as a framework's loader delivers them.

torchrun --nproc-per-node=2 framework_worker.py OUT SET FRAMEWORK HOW

HOW: "batches" prepares a loader as one would first try, "whole" as docs/how-to/frameworks.md says, "loader" with
`loader`. Each rank writes OUT/RANK.json: a list of keys, or the line of the error.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch
from torch.utils.data import DataLoader

from bodyseg_data import RangeImages, loader
from bodyseg_data.core import BadConfig


def by_accelerate(images: RangeImages, how: str) -> Iterable[dict[str, Any]]:
    from accelerate import Accelerator

    accelerator = Accelerator(cpu=True)
    if how == "loader":
        return loader(images, 3)
    ranks = {"rank": 0, "world_size": 1} if how == "whole" else {}
    prepared: Iterable[dict[str, Any]] = accelerator.prepare(
        DataLoader(images, batch_sampler=images.batches(3, **ranks))
    )
    return prepared


def by_fabric(images: RangeImages, how: str) -> Iterable[dict[str, Any]]:
    from lightning.fabric import Fabric

    fabric = Fabric(accelerator="cpu", devices=2, strategy="ddp")
    fabric.launch()
    if how == "loader":
        return loader(images, 3)
    made = DataLoader(images, batch_sampler=images.batches(3))
    prepared: Iterable[dict[str, Any]] = fabric.setup_dataloaders(made, use_distributed_sampler=how != "whole")
    return prepared


def by_lightning(images: RangeImages, how: str) -> Iterable[dict[str, Any]]:
    import lightning

    seen: list[dict[str, Any]] = []

    class Noting(lightning.LightningModule):
        def __init__(self) -> None:
            super().__init__()
            self.weight = torch.nn.Parameter(torch.zeros(1))

        def training_step(self, batch: dict[str, Any], number: int) -> torch.Tensor:
            seen.append(batch)
            return self.weight.sum()

        def configure_optimizers(self) -> torch.optim.Optimizer:
            return torch.optim.SGD(self.parameters(), 0.1)

        def train_dataloader(self) -> Any:
            return loader(images, 3) if how == "loader" else DataLoader(images, batch_sampler=images.batches(3))

    trainer = lightning.Trainer(
        accelerator="cpu",
        devices=2,
        strategy="ddp",
        max_epochs=1,
        use_distributed_sampler=how == "batches",
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    trainer.fit(Noting())
    return seen


FRAMEWORKS = {"accelerate": by_accelerate, "fabric": by_fabric, "lightning": by_lightning}

if __name__ == "__main__":
    out, folder, framework, how = sys.argv[1:]
    images = RangeImages(folder, "none", split="train", seed=0)
    found: Any
    try:
        found = [key for batch in FRAMEWORKS[framework](images, how) for key in batch["key"]]
    except BadConfig as error:
        found = str(error)
    (Path(out) / f"{os.environ['RANK']}.json").write_text(json.dumps(found))
