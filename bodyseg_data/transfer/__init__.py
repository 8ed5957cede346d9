"""Copies of sets and networks between folders and addresses: resumed, verified, complete only at their end."""

from typing import TYPE_CHECKING

from bodyseg_data.core import lazy_door

if TYPE_CHECKING:
    from bodyseg_data.transfer.transfers import (
        Bundle,
        LocalTarget,
        RemoteTarget,
        SharedFile,
        Target,
        pages_of,
        read_page,
        set_bundle,
        transfer,
    )
else:
    __getattr__, __dir__, __all__ = lazy_door(__name__)
