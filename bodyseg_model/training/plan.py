"""The plan of a training, all that its result depends on, as plain JSON; and the folder in which a training stands.

run.json                  the plan (`training_plan`), written after the first step; only this plan may resume
checkpoint.json           the last checkpoint: step, state of the loader, name and SHA-256 of its tensors
checkpoint-STEP.safetensors
best.safetensors, best.json   weights and card of the best validation
log.jsonl                 a line of metrics every few steps
tensorboard/              the same for TensorBoard
network.safetensors, network.json   the trained network and its card
"""

import contextlib
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

from bodyseg_data.core import BadConfig, check_seed, reported
from bodyseg_data.files import entries_of, make_folder, read_bytes, read_json, write_json, write_result
from bodyseg_data.labels import PARTS33
from bodyseg_data.loading import first_difference
from bodyseg_model.networks import CardWords, Checkpoint, Network, RunFiles, read_checkpoint
from bodyseg_model.training.recipes import Recipe
from bodyseg_model.training.turns import Turns
from bodyseg_model.training.validation import Validation

_LONGEST: Final = 60  # characters of a value

FORMAT: Final = "bodyseg run 1"


def training_plan(
    name: str,
    network: Network,
    images: Turns,
    recipe: Recipe,
    seed: int,
    validation: Validation | None,
    pretrained: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Everything that a training's result depends on, as plain JSON: the same plan gives the same weights.

    name: of the network in `names.NETWORKS`. Keys: network, settings, variant, seed, recipe, rig (`Rig.to_json`) and
    sensor (name and artifacts) of the images, of several sets those of the first, data (identity of the images),
    labels (`LabelMap.to_json`) where they are not the 33 parts; validation and pretrained where there is one.
    """
    first = images.sets[0]
    sensor = first.augmentation.sensor.to_json()
    plan = {
        "network": name,
        "settings": network.settings,
        "variant": images.variant,
        "seed": check_seed(seed),
        "recipe": recipe.to_json(),
        "rig": first.manifest.rig.to_json(),
        "sensor": {"name": sensor["name"], "artifacts": sensor["artifacts"]},
        "data": images.identity(),  # behind what decides it: a refusal names the first fields that differ
    }
    if images.label_map != PARTS33:
        plan["labels"] = images.label_map.to_json()
    if validation is not None:
        plan["validation"] = validation.plan()
    if pretrained is not None:
        plan[CardWords.PRETRAINED] = dict(pretrained)
    tree: dict[str, Any] = json.loads(json.dumps(plan))
    return tree


def check_plan(folder: Path, found: dict[str, Any], wanted: dict[str, Any], reached: int) -> None:
    """Raise BadConfig, naming the first field that differs, unless the training `found` may go on as `wanted`.

    reached: number of steps that it has done. The number of steps may differ, but be no smaller than that.
    """
    steps = wanted["recipe"]["steps"]
    if steps < reached:
        raise BadConfig(f"{folder} has reached step {reached}: --steps must be at least that, found {steps}")
    before, after = _but_steps(found), _but_steps(wanted)
    if before != after:
        name, was, now = first_difference("", before, after)
        raise BadConfig(f"{folder} holds another training: {name[1:]} was {_shown(was)}, now {_shown(now)}")


def _but_steps(plan: dict[str, Any]) -> dict[str, Any]:
    recipe = plan.get("recipe")
    return plan if not isinstance(recipe, dict) else {**plan, "recipe": {**recipe, "steps": None}}


def _shown(value: Any) -> str:
    text = "not given" if value is None else json.dumps(value)
    return text if len(text) <= _LONGEST else "given"


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
        return self.path / RunFiles.NETWORK

    def begin(self, plan: Mapping[str, Any], resume: bool) -> Checkpoint | None:
        """Open the folder for the training that `plan` describes; returns its last checkpoint if it has one.

        The number of steps may differ from that of the plan in the folder, which then takes the new one and lists the
        old one under "earlier_steps". Weights to start from ("pretrained") need not be named again. A folder that holds
        no more than a plan can be begun anew, with any plan.

        Raises BadConfig for a folder that holds another training, or this one without `resume`.
        """
        make_folder(self.path)
        wanted = json.loads(json.dumps({"format": FORMAT, **plan}))
        file = self.path / RunFiles.PLAN
        held = {entry.name for entry in entries_of(self.path)}
        found = read_json(file) if RunFiles.PLAN in held else {}
        if held and found.get("format") != FORMAT:
            raise BadConfig(f"{self.path} holds files but no training: give a new or empty folder")
        if held <= {RunFiles.PLAN}:
            file.unlink(missing_ok=True)
            return None
        earlier = found.pop("earlier_steps", [])
        if CardWords.PRETRAINED in found:
            wanted.setdefault(CardWords.PRETRAINED, found[CardWords.PRETRAINED])
        checkpoint = read_checkpoint(self.path)
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
        if not (self.path / RunFiles.PLAN).exists():
            write_json(self.path / RunFiles.PLAN, {"format": FORMAT, **plan})

    def plan(self) -> dict[str, Any]:
        """The plan that the folder holds, with the "earlier_steps" of a training that was given other numbers of steps.

        Raises BadConfig.
        """
        plan = read_json(self.path / RunFiles.PLAN)
        del plan["format"]
        return plan

    def best(self) -> Best | None:
        """The best validation, None before the first. Raises BadConfig if its card is damaged."""
        card = (self.path / RunFiles.BEST).with_suffix(".json")
        if not card.exists():
            return None
        step, accuracy = (read_json(card).get(name) for name in ("step", "val_accuracy"))
        if not isinstance(step, int) or not isinstance(accuracy, float):
            raise BadConfig(f"{card} must hold the step and the val_accuracy of a validation")
        return Best(step, accuracy)

    def log(self, metrics: Mapping[str, Any]) -> None:
        """Append a line of metrics. Raises BadConfig."""
        file = self.path / "log.jsonl"
        with reported(f"cannot write {file}", BadConfig, OSError), file.open("a") as log:
            log.write(json.dumps(metrics) + "\n")

    def forget_after(self, step: int) -> None:
        """Drop lines of the log after `step`, which a resumed training repeats, and a line that a kill cut short; and a
        best validation after it, where another number of steps, and so other learning rates, follow: also one of which
        a kill left the weights alone, beside the card of the best before.
        """
        changes = self.plan().get("earlier_steps") if (self.path / RunFiles.PLAN).exists() else None
        if changes and (best := self.best()) is not None and changes[-1]["until"] == step:
            weights = self.path / RunFiles.BEST
            digest = hashlib.sha256(read_bytes(weights)).hexdigest()
            if best.step > step or read_json(weights.with_suffix(".json"))[CardWords.WEIGHTS_SHA256] != digest:
                weights.with_suffix(".json").unlink()
                weights.unlink()
        file = self.path / "log.jsonl"
        if not file.exists():
            return
        kept = []
        for line in file.read_bytes().splitlines():
            with contextlib.suppress(ValueError, KeyError, TypeError):
                if json.loads(line)["step"] <= step:
                    kept.append(line + b"\n")
        write_result(file, b"".join(kept))
