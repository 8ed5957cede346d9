"""`bodyseg sensor show`: one sensor model as TOML."""

from __future__ import annotations

import sys
from dataclasses import dataclass

from bodyseg_data.artifacts.sensor_model import load_sensor_model, sensor_model_names
from bodyseg_data.commands.options import option

EXAMPLE = "bodyseg sensor show kinect_v1"


@dataclass(frozen=True)
class Options:
    """Options of the command."""

    sensor: str = option(f"one of {', '.join(sensor_model_names())}, or a TOML file", positional=True, address=True)


def run(options: Options) -> int:
    """Print the model with every strength, those left out in the file at their defaults."""
    sys.stdout.write(load_sensor_model(options.sensor).to_toml())
    return 0
