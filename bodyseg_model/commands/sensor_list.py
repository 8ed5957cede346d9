"""`bodyseg sensor list`: the sensor models that ship with the package."""

from __future__ import annotations

import sys
from dataclasses import dataclass

from bodyseg_data.artifacts.sensor_model import load_sensor_model, sensor_model_names

EXAMPLE = "bodyseg sensor list"


@dataclass(frozen=True)
class Options:
    """The command has no options."""


def run(options: Options) -> int:
    """Print one line for each sensor: its name, title and artifacts."""
    models = [load_sensor_model(name) for name in sensor_model_names()]
    name, title = (max(len(getattr(model, field)) for model in models) for field in ("name", "title"))
    for model in models:
        artifacts = ", ".join(artifact.name for artifact in model)
        sys.stdout.write(f"{model.name:{name}}  {model.title:{title}}  {artifacts}\n")
    return 0
