"""`bodyseg sensor list` and `bodyseg sensor show`: the sensor models that ship with the package, and one as TOML."""

from __future__ import annotations

import sys
from dataclasses import dataclass

from bodyseg_data.artifacts import load_sensor_model, sensor_model_names
from bodyseg_data.commands import option


class ListSensors:
    """`bodyseg sensor list`."""

    EXAMPLE = "bodyseg sensor list"

    @dataclass(frozen=True)
    class Options:
        """The command has no options."""

    @staticmethod
    def run(options: Options) -> int:
        """Print one line for each sensor: its name, title and artifacts."""
        models = [load_sensor_model(name) for name in sensor_model_names()]
        name, title = (max(len(getattr(model, field)) for model in models) for field in ("name", "title"))
        for model in models:
            artifacts = ", ".join(artifact.name for artifact in model)
            sys.stdout.write(f"{model.name:{name}}  {model.title:{title}}  {artifacts}\n")
        return 0


class ShowSensor:
    """`bodyseg sensor show`."""

    EXAMPLE = "bodyseg sensor show kinect_v1"

    @dataclass(frozen=True)
    class Options:
        """Options of the command."""

        sensor: str = option(f"one of {', '.join(sensor_model_names())}, or a TOML file", positional=True, address=True)

    @staticmethod
    def run(options: Options) -> int:
        """Print the model with every strength, those left out in the file at their defaults."""
        sys.stdout.write(load_sensor_model(options.sensor).to_toml())
        return 0
