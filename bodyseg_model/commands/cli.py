"""`bodyseg <command>`, and `tools/<command>` in a checkout: the commands of both packages."""

from collections.abc import Sequence
from typing import Final

from bodyseg_data.commands import COMMANDS as SET_COMMANDS
from bodyseg_data.commands import Commands
from bodyseg_data.commands import main as run_command

COMMANDS: Final[Commands] = {
    **SET_COMMANDS,
    "cut": ("bodyseg_model.commands.cut", "cut people out of whole frames, into a set to train on"),
    "train": ("bodyseg_model.commands.train", "train a network on one variant of a set"),
    "evaluate": ("bodyseg_model.commands.evaluate", "score a network on a set"),
    "export": ("bodyseg_model.commands.export", "write a trained network as two small files, or as ONNX"),
    "export-labels": ("bodyseg_model.commands.export_labels", "write labels in formats of other programs"),
    "push": ("bodyseg_model.commands.sharing:Push", "copy a set or a network to an address"),
    "pull": ("bodyseg_model.commands.sharing:Pull", "copy a set or a network from an address"),
    "segment": ("bodyseg_model.commands.segment", "find the parts of people in frames of a sensor"),
    "sensor fit": ("bodyseg_model.commands.sensor", "measure which artifacts a sensor has from its own frames"),
    "sensor show": ("bodyseg_model.commands.sensor:ShowSensor", "print a sensor model as TOML"),
    "view": ("bodyseg_model.commands.view", "show a set or a recording in the browser"),
    "stability": ("bodyseg_model.commands.stability", "measure robustness to sensor artifacts"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one of `COMMANDS`; see `bodyseg_data.commands.main`."""
    return run_command(arguments, COMMANDS)
