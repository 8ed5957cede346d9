"""The folder of a training: its plan, its last checkpoint, its log, and the trained network.

run.json                  network, settings, recipe, seed and data: written first; only the same plan may resume
checkpoint.json           the last checkpoint: step, state of the loader, name and SHA-256 of its tensors
checkpoint-STEP.safetensors
log.jsonl                 a line of metrics every few steps
tensorboard/              the same for TensorBoard
network.safetensors, network.json   the trained network and its card
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import torch

from bodyseg_data.core.errors import BadConfig
from bodyseg_model.networks.checkpoints import NETWORK, read_bytes, read_json, read_tensors, write_json, write_tensors

FORMAT: Final = "bodyseg run 1"


@dataclass(frozen=True)
class Checkpoint:
    """State of a training after `step` steps. loader_state: `Loader.state_dict`. tensors: of network and optimiser."""

    step: int
    loader_state: dict[str, Any]
    tensors: dict[str, torch.Tensor]


@dataclass(frozen=True)
class RunFolder:
    """The files of one training."""

    path: Path

    @property
    def network(self) -> Path:
        """Path of the trained network."""
        return self.path / NETWORK

    def begin(self, plan: Mapping[str, Any], resume: bool) -> Checkpoint | None:
        """Open the folder for the training that `plan` describes; returns its last checkpoint if it has one.

        Raises BadConfig for a folder that holds another training, or this one without `resume`.
        """
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise BadConfig(f"cannot make the folder {self.path}: {error.strerror or error}") from error
        file = self.path / "run.json"
        wanted = json.loads(json.dumps({"format": FORMAT, **plan}))
        if not file.exists():
            if any(self.path.iterdir()):
                raise BadConfig(f"{self.path} holds files but no training: give a new or empty folder")
            write_json(file, wanted)
            return None
        found = read_json(file)
        for name in [*wanted, *sorted(found.keys() - wanted.keys())]:
            if wanted.get(name) != found.get(name):
                raise BadConfig(
                    f"{self.path} holds another training: {name} was {found.get(name)!r}, now {wanted.get(name)!r}"
                )
        if not resume:
            raise BadConfig(f"{self.path} holds this training already: --resume carries it on")
        return self.last()

    def last(self) -> Checkpoint | None:
        """The last checkpoint. Raises BadConfig if it is damaged."""
        file = self.path / "checkpoint.json"
        if not file.exists():
            return None
        note = read_json(file)
        name, digest, step, state = (note.get(key) for key in ("tensors", "sha256", "step", "loader_state"))
        if not isinstance(step, int) or not isinstance(state, dict) or name != _tensors_name(step):
            raise BadConfig(f"{file} must hold the step, loader_state and tensors of a checkpoint")
        found = hashlib.sha256(read_bytes(self.path / name)).hexdigest()
        if found != digest:
            raise BadConfig(f"{self.path / name} is damaged: SHA-256 {found}, expected {digest}")
        return Checkpoint(step, state, read_tensors(self.path / name))

    def keep(self, checkpoint: Checkpoint) -> None:
        """Write a checkpoint, and delete the one before when this one is complete. Raises BadConfig."""
        tensors = self.path / _tensors_name(checkpoint.step)
        digest = write_tensors(tensors, checkpoint.tensors)
        state = checkpoint.loader_state
        note = {"step": checkpoint.step, "loader_state": state, "tensors": tensors.name, "sha256": digest}
        write_json(self.path / "checkpoint.json", note)
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


def _tensors_name(step: int) -> str:
    return f"checkpoint-{step:08d}.safetensors"
