"""The plan of a training: all that its result depends on, as plain JSON, and the differences between two plans."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.labels.label_map import PARTS33
from bodyseg_data.loading.image_set import ImageSet
from bodyseg_model.networks.checkpoints import PRETRAINED
from bodyseg_model.networks.network import Network
from bodyseg_model.training.recipes import Recipe
from bodyseg_model.training.validation import Validation

Keys = tuple[str, ...]
"""Keys that lead to a field of a plan."""

FLAGS: Final[dict[str, str]] = {
    "network": "--network",
    "settings": "--settings",
    "variant": "--variant",
    "seed": "--seed",
    "recipe": "--recipe",
    "recipe.steps": "--steps",
    "recipe.batch_size": "--batch-size",
    "recipe.accumulate": "--accumulate",
    "recipe.learning_rate": "--lr",
    "recipe.bf16": "--precision",
    "recipe.ema": "--ema",
    "recipe.geometric_augmentation": "--no-geometric-augmentation",
    "data": "--data",
    "data.variant": "--variant",
    "data.seed": "--seed",
    "data.artifacts": "--artifacts",
    "data.only": "--only",
    "data.where": "--where",
    "data.weight": "--weights",
    "data.val_share": "--val-share",
    "data.labels": "--labels",
    "labels": "--labels",
    "pretrained": "--pretrained",
    "sensor": "--sensor",
    "sensor.artifacts": "--artifacts",
    "rig": "--data rig",
    "validation": "--val-share",
    "validation.every": "--val-every",
    "validation.images": "--val-images",
}
"""Field of a plan -> the option of `bodyseg train` that sets it and all fields below it that have no entry."""

_FOLLOWS: Final[dict[str, tuple[str, ...]]] = {
    "--data": ("--data rig", "--only", "--where", "--val-share"),
    "--artifacts": ("--variant", "--sensor"),
    "--settings": ("--labels",),
    "--val-share": ("--data", "--only", "--where", "--variant", "--seed", "--artifacts", "--sensor", "--labels"),
}
"""Option -> options whose difference alters its fields as well, so that its own would be told twice."""

_ABSENT: Final = object()
_SHOWN: Final = 3


def training_plan(
    name: str,
    network: Network,
    images: ImageSet,
    recipe: Recipe,
    seed: int,
    validation: Validation | None,
    pretrained: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Everything that a training's result depends on, as plain JSON: the same plan gives the same weights.

    name: of the network in `registry.NETWORKS`. Keys: network, settings, variant, seed, recipe, data (identity of the
    images), rig (`Rig.to_json`) and sensor (name and artifacts) of the images, of a mixture those of its first set,
    labels (`LabelMap.to_json`) where they are not the 33 parts; validation and pretrained where there is one.
    """
    first = images.sets[0]
    sensor = first.augmentation.sensor.to_json()
    plan = {
        "network": name,
        "settings": network.settings,
        "variant": images.variant,
        "seed": seed,
        "recipe": recipe.to_json(),
        "data": images.identity(),
        "rig": first.manifest.rig.to_json(),
        "sensor": {"name": sensor["name"], "artifacts": sensor["artifacts"]},
    }
    if images.label_map != PARTS33:
        plan["labels"] = images.label_map.to_json()
    if validation is not None:
        plan["validation"] = validation.plan()
    if pretrained is not None:
        plan[PRETRAINED] = pretrained
    tree: dict[str, Any] = json.loads(json.dumps(plan))
    return tree


def check_plan(folder: Path, found: dict[str, Any], wanted: dict[str, Any], reached: int) -> None:
    """Raise BadConfig, naming the options that differ, unless the training `found` in a folder may go on as `wanted`.

    reached: number of steps that it has done. The number of steps may differ, but be no smaller than that.
    """
    sets = [_set_count(plan) for plan in (found, wanted)]
    if sets[0] != sets[1]:
        raise BadConfig(f"{folder} holds another training: --data was {_sets(sets[0])}, now {_sets(sets[1])}")
    told: dict[str, list[str]] = {}
    for path, was, now in differences(found, wanted):
        if path == ("recipe", "steps") and isinstance(now, int) and now >= reached:
            continue
        flag, rest = option_of(path)
        if path[0] == "validation" and flag in told:
            continue  # whether, and on what, follows from --val-share
        line = " ".join([flag, *rest]) + f" was {_shown(path, was)}, now {_shown(path, now)}"
        if line not in told.setdefault(flag, []):  # a label map stands in the plan and in the images' identity
            told[flag].append(line)
    if list(told) == ["--steps"]:
        steps = wanted["recipe"]["steps"]
        raise BadConfig(f"{folder} has reached step {reached}: --steps must be at least that, found {steps}")
    lines = [
        line
        for flag, lines in told.items()
        if not any(other in told for other in _FOLLOWS.get(flag, ()))
        for line in lines
    ]
    if lines:
        more = f" and {len(lines) - _SHOWN} more" if len(lines) > _SHOWN else ""
        raise BadConfig(f"{folder} holds another training: {'; '.join(lines[:_SHOWN])}{more}")


def _set_count(plan: dict[str, Any]) -> int:
    """Number of sets that a training reads: the identity of a mixture lists those of its sets."""
    data = plan.get("data")
    mixture = data.get("mixture") if isinstance(data, dict) else None
    return len(mixture) if isinstance(mixture, list) else 1


def _sets(count: int) -> str:
    return f"{count} {'set' if count == 1 else 'sets'}"


def differences(was: Any, now: Any, path: Keys = ()) -> Iterator[tuple[Keys, Any, Any]]:
    """Innermost fields in which two trees of JSON differ: their keys, and both values.

    Entries of lists of objects are compared by their name, or else by their number; if only their order differs, the
    values are the names in both orders.
    """
    named_was, named_now = _by_name(was), _by_name(now)
    if not isinstance(named_was, dict) or not isinstance(named_now, dict):
        if was != now:
            yield path, was, now
    elif isinstance(was, list) and named_was == named_now and [*named_was] != [*named_now]:
        yield path, [*named_was], [*named_now]
    else:
        for key in [*named_now, *sorted(named_was.keys() - named_now.keys())]:
            yield from differences(named_was.get(key, _ABSENT), named_now.get(key, _ABSENT), (*path, key))


def _by_name(tree: Any) -> Any:
    if not isinstance(tree, list) or not all(isinstance(each, dict) for each in tree):
        return tree
    named = {str(each.get("artifact", each.get("name", number))): each for number, each in enumerate(tree)}
    return named if len(named) == len(tree) else {str(number): each for number, each in enumerate(tree)}


def option_of(path: Keys) -> tuple[str, Keys]:
    """Return the option that sets a field of a plan, and the keys below those that it stands for.

    The fields of all sets of a mixture belong to the same options.
    """
    if path[:2] == ("data", "mixture"):
        path = ("data", *path[3:])
    for length in range(len(path), 0, -1):
        flag = FLAGS.get(".".join(path[:length]))
        if flag is not None:
            return flag, path[length:]
    return path[0], path[1:]


def _shown(path: Keys, value: Any) -> str:
    if value is _ABSENT:
        return "not given"
    if isinstance(value, dict):
        return json.dumps(value["name"]) if "name" in value else "given"
    if path == ("recipe", "bf16"):
        return "bfloat16" if value else "float32"
    return json.dumps(value)
