"""Commands that use networks, one module each."""

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_model.commands.cli import main
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
