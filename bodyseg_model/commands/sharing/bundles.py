"""Bundles of networks, and the work that push and pull share."""

from __future__ import annotations

import sys
from pathlib import Path

from bodyseg_data.commands.progress import Progress
from bodyseg_data.core.errors import BadConfig
from bodyseg_data.core.files import parse_json
from bodyseg_data.shards.stores.store import Store
from bodyseg_data.transfer.bundle import Bundle, SharedFile, pages_of, read_page
from bodyseg_data.transfer.targets import Target
from bodyseg_data.transfer.transfer import transfer
from bodyseg_model.networks.checkpoints import FORMAT, NETWORK, WEIGHTS_SHA256, confusion_file
from bodyseg_model.networks.model_card import page_file


def network_bundle(store: Store, weights: str = NETWORK) -> Bundle:
    """Return the bundle of a network: weights, page and confusion matrix, card.

    weights: name of its .safetensors file in the store. Raises BadConfig for a card that cannot vouch for the weights,
    OSError or Unreachable.
    """
    file = Path(weights)
    index = file.with_suffix(".json").name
    data = read_page(store, index)
    card = parse_json(data, f"{store.name}/{index}")
    digest = card.get(WEIGHTS_SHA256)
    if card.get("format") != FORMAT or not isinstance(digest, str):
        raise BadConfig(f"{store.name}/{index} is no card of a network with {WEIGHTS_SHA256!r}")
    page = "README.md" if weights == NETWORK else page_file(file).name
    pages = pages_of(store, (page, confusion_file(file).name))
    return Bundle((SharedFile(weights, store.size(weights), digest),), index, data, pages)


def copy(bundle: Bundle, target: Target, title: str, replace: bool, sizes_only: bool = False) -> None:
    """Copy a bundle with progress, and say what was done."""
    with Progress(title, "MB") as progress:
        total = round(bundle.size / 1e6)
        outcome = transfer(
            bundle,
            target,
            lambda done: progress.update(min(round(done / 1e6), total), total),
            replace,
            sizes_only,
        )
    files = "1 file" if outcome.files == 1 else f"{outcome.files} files"
    sys.stdout.write(
        f"{target.store.name}: {files} and {bundle.index}, {bundle.size / 1e6:.1f} MB: {outcome.kept} were there, "
        f"{outcome.copied_bytes / 1e6:.1f} MB copied\n"
    )
