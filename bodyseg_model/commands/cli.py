"""`bodyseg <command>`, and `tools/<command>` in a checkout: the commands of both packages."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from bodyseg_data.commands import cli

COMMANDS: Final[cli.Commands] = {
    **cli.COMMANDS,
    "train": ("bodyseg_model.commands.train", "train a network on one variant of a set"),
    "evaluate": ("bodyseg_model.commands.evaluate", "score a network on a set"),
    "export": ("bodyseg_model.commands.export", "write a trained network as two small files"),
    "card": ("bodyseg_model.commands.card", "write the cards of a set or a network beside it"),
    "push": ("bodyseg_model.commands.sharing:Push", "copy a set or a network to an address"),
    "pull": ("bodyseg_model.commands.sharing:Pull", "copy a set or a network from an address"),
    "segment": ("bodyseg_model.commands.segment", "find the parts of people in frames of a sensor"),
    "sensor fit": ("bodyseg_model.commands.sensor_fit", "measure which artifacts a sensor has from its own frames"),
    "sensor list": (
        "bodyseg_model.commands.sensor_models:ListSensors",
        "list the sensor models that ship with the package",
    ),
    "sensor show": ("bodyseg_model.commands.sensor_models:ShowSensor", "print a sensor model as TOML"),
    "view": ("bodyseg_model.commands.view", "show a set or a recording in the browser"),
    "stability": ("bodyseg_model.commands.stability", "measure robustness to sensor artifacts, motion, arithmetic"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one of `COMMANDS`; see `bodyseg_data.commands.main`."""
    return cli.main(arguments, COMMANDS)
