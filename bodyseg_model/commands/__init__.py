"""Commands that use networks, one module each.

They import rooms whole, and a name of a room where it is used, as help and refused options need no PyTorch.
"""

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_model.commands.cli import main
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
