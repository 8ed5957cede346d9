"""`bodyseg pull`: copy a set or a network from an address."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from bodyseg_data.commands.options import option
from bodyseg_data.core.errors import BadConfig
from bodyseg_data.shards.stores.addresses import open_store
from bodyseg_data.shards.stores.store import Store
from bodyseg_data.transfer.bundle import Bundle, set_bundle
from bodyseg_data.transfer.targets import LocalTarget

EXAMPLE = "bodyseg pull https://host/shards shards"

_WEIGHTS: Final = ".safetensors"
_LARGEST: Final = 1 << 28


@dataclass(frozen=True)
class Options:
    """Options of the command."""

    address: str = option(
        "address of a set, of a training's folder or of a .safetensors file", positional=True, address=True
    )
    folder: Path = option("folder that gets the copy", positional=True)
    replace: bool = option("replace another set or network in the folder", False)


def run(options: Options) -> int:
    """Copy, and print one line on what was copied."""
    from bodyseg_model.commands.sharing.bundles import copy

    store, bundle = _bundle(options.address)
    copy(bundle, LocalTarget(options.folder, store), "pulling", options.replace)
    return 0


def _bundle(address: str) -> tuple[Store, Bundle]:
    """Open the store at an address, and find the set or network there."""
    from bodyseg_model.commands.sharing.bundles import network_bundle
    from bodyseg_model.networks.checkpoints import NETWORK

    path, mark, query = address.partition("?") if address.startswith(("http://", "https://")) else (address, "", "")
    weights = path.rpartition("/")[2] if path.endswith(_WEIGHTS) else ""
    if weights:
        parent = path.rpartition("/")[0] if "/" in path else "."
        store, _ = open_store(f"{parent}{mark}{query}")
        return store, network_bundle(store, weights)
    store, pattern = open_store(address)
    if pattern != "*":
        raise BadConfig(f"a whole set is copied, found {pattern!r} at the end of its address")
    if store.read_file(Path(NETWORK).with_suffix(".json").name, _LARGEST) is not None:
        return store, network_bundle(store)
    return store, set_bundle(store)
