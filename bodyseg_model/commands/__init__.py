"""Commands that use networks, one module each.

What needs PyTorch is named by its room where it is used, so that help and refused options come without; all else may be
imported by name.
"""

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_model.commands.cli import main
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
