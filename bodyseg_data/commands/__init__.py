"""Commands of `bodyseg`: one module a command, each with its options, an example and `run`."""

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_data.commands.cli import COMMANDS, Commands, main
    from bodyseg_data.commands.options import OCCLUDER_HELP, WHERE_HELP, command_line, flag_of, headings, option
    from bodyseg_data.commands.progress import Progress, rate_text
    from bodyseg_data.commands.records import check_target, provenance
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
