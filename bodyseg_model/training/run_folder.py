"""The folder of a training: its plan, its last and best checkpoint, its log, and the trained network.

run.json                  the plan (`plan.training_plan`), written after the first step; only this plan may resume
checkpoint.json           the last checkpoint: step, state of the loader, name and SHA-256 of its tensors
checkpoint-STEP.safetensors
best.safetensors, best.json   weights and card of the best validation
log.jsonl                 a line of metrics every few steps
tensorboard/              the same for TensorBoard
network.safetensors, network.json   the trained network and its card
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.files import make_folder
from bodyseg_model.networks.checkpoints import (
    BEST,
    CHECKPOINT,
    NETWORK,
    PLAN,
    PRETRAINED,
    Checkpoint,
    checkpoint_file,
    read_checkpoint,
    read_json,
    write_json,
    write_tensors,
)
from bodyseg_model.training.plan import check_plan

FORMAT: Final = "bodyseg run 1"


class Best(NamedTuple):
    """The best validation so far. step: number of steps done. accuracy: average per class."""

    step: int
    accuracy: float


@dataclass(frozen=True)
class RunFolder:
    """The files of one training."""

    path: Path

    @property
    def network(self) -> Path:
        """Path of the trained network."""
        return self.path / NETWORK

    @property
    def best_network(self) -> Path:
        """Path of the weights of the best validation."""
        return self.path / BEST

    def begin(self, plan: Mapping[str, Any], resume: bool) -> Checkpoint | None:
        """Open the folder for the training that `plan` describes; returns its last checkpoint if it has one.

        The number of steps may differ from that of the plan in the folder, which then takes the new one and lists the
        old one under "earlier_steps". Weights to start from ("pretrained") need not be named again. A folder that holds
        no more than a plan can be begun anew, with any plan.

        Raises BadConfig for a folder that holds another training, or this one without `resume`.
        """
        make_folder(self.path)
        wanted = json.loads(json.dumps({"format": FORMAT, **plan}))
        file = self.path / PLAN
        held = {entry.name for entry in self.path.iterdir()}
        if held <= {PLAN, f".{PLAN}.part"}:
            file.unlink(missing_ok=True)
            return None
        if PLAN not in held:
            raise BadConfig(f"{self.path} holds files but no training: give a new or empty folder")
        found = read_json(file)
        earlier = found.pop("earlier_steps", [])
        if PRETRAINED in found:
            wanted.setdefault(PRETRAINED, found[PRETRAINED])
        checkpoint = self.last()
        reached = 0 if checkpoint is None else checkpoint.step
        check_plan(self.path, found, wanted, reached)
        if not resume:
            raise BadConfig(f"{self.path} holds this training already: --resume carries it on")
        before = found["recipe"].get("steps")
        if before != wanted["recipe"]["steps"]:
            write_json(file, {**wanted, "earlier_steps": [*earlier, {"steps": before, "until": reached}]})
        return checkpoint

    def start(self, plan: Mapping[str, Any]) -> None:
        """Write the plan of a new training, whose first step is done. Raises BadConfig."""
        if not (self.path / PLAN).exists():
            write_json(self.path / PLAN, {"format": FORMAT, **plan})

    def plan(self) -> dict[str, Any]:
        """The plan that the folder holds, with the "earlier_steps" of a training that was given other numbers of steps.

        Raises BadConfig.
        """
        plan = read_json(self.path / PLAN)
        del plan["format"]
        return plan

    def last(self) -> Checkpoint | None:
        """The last checkpoint. Raises BadConfig if it is damaged."""
        return read_checkpoint(self.path)

    def best(self) -> Best | None:
        """The best validation, None before the first. Raises BadConfig if its card is damaged."""
        card = self.best_network.with_suffix(".json")
        if not card.exists():
            return None
        step, accuracy = (read_json(card).get(name) for name in ("step", "val_accuracy"))
        if not isinstance(step, int) or not isinstance(accuracy, float):
            raise BadConfig(f"{card} must hold the step and the val_accuracy of a validation")
        return Best(step, accuracy)

    def keep(self, checkpoint: Checkpoint) -> None:
        """Write a checkpoint, and delete the one before when this one is complete. Raises BadConfig."""
        tensors = self.path / checkpoint_file(checkpoint.step)
        digest = write_tensors(tensors, checkpoint.tensors)
        state = checkpoint.loader_state
        note = {"step": checkpoint.step, "loader_state": state, "tensors": tensors.name, "sha256": digest}
        write_json(self.path / CHECKPOINT, note)
        for old in self.path.glob("checkpoint-*.safetensors"):
            if old != tensors:
                with contextlib.suppress(OSError):
                    old.unlink()

    def log(self, metrics: Mapping[str, Any]) -> None:
        """Append a line of metrics. Raises BadConfig."""
        try:
            with (self.path / "log.jsonl").open("a") as file:
                file.write(json.dumps(metrics) + "\n")
        except OSError as error:
            raise BadConfig(f"cannot write {self.path / 'log.jsonl'}: {error.strerror or error}") from error

    def forget_after(self, step: int) -> None:
        """Drop lines of the log after `step`, which a resumed training repeats, and a line that a kill cut short."""
        file = self.path / "log.jsonl"
        if not file.exists():
            return
        kept = []
        for line in file.read_text().splitlines():
            with contextlib.suppress(ValueError, KeyError, TypeError):
                if json.loads(line)["step"] <= step:
                    kept.append(line + "\n")
        file.write_text("".join(kept))
