"""`bodyseg push`: copy a set or a network to an address."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from bodyseg_data.commands.options import option
from bodyseg_data.core.errors import BadConfig
from bodyseg_data.shards.manifest import MANIFEST_NAME
from bodyseg_data.shards.stores.addresses import open_store
from bodyseg_data.shards.stores.remote import RemoteFolder
from bodyseg_data.shards.stores.store import LocalFolder
from bodyseg_data.transfer.bundle import set_bundle
from bodyseg_data.transfer.targets import LocalTarget, RemoteTarget, Target

EXAMPLE = "bodyseg push shards s3://bucket/shards"


@dataclass(frozen=True)
class Options:
    """Options of the command."""

    what: Path = option("folder of a set, folder of a training, or a .safetensors file", positional=True)
    address: str = option("folder or address that gets the copy", positional=True, address=True)
    replace: bool = option("replace another set or network at the address", False)
    sizes_only: bool = option("compare files at the address by size alone: they are not read back", False)


def run(options: Options) -> int:
    """Copy, and print one line on what was copied."""
    from bodyseg_model.commands.sharing.bundles import copy, network_bundle
    from bodyseg_model.networks.model_card import network_file

    if (options.what / MANIFEST_NAME).exists():
        folder = options.what
        bundle = set_bundle(LocalFolder(folder))
    else:
        weights = network_file(options.what)
        folder = weights.parent
        bundle = network_bundle(LocalFolder(folder), weights.name)
    store, pattern = open_store(options.address)
    if pattern != "*":
        raise BadConfig(f"a copy needs the address of a folder, found {pattern!r} at its end")
    target: Target
    if isinstance(store, RemoteFolder):
        target = RemoteTarget(store, folder)
    else:
        target = LocalTarget(Path(store.name), LocalFolder(folder))
    copy(bundle, target, "pushing", options.replace, options.sizes_only)
    return 0
