"""`bodyseg push` and `pull`: copy a set or a network to an address, or from one."""

import sys
from dataclasses import dataclass
from pathlib import Path

from bodyseg_data import transfer
from bodyseg_data.commands import Progress, option
from bodyseg_data.core import BadConfig
from bodyseg_data.files import parse_json
from bodyseg_data.shards import MANIFEST_NAME, LocalFolder, RemoteFolder, Store, open_store
from bodyseg_model.networks import CardWords, RunFiles, confusion_file


class Push:
    EXAMPLE = "bodyseg push shards s3://bucket/shards"

    @dataclass(frozen=True)
    class Options:
        what: Path = option("what to copy: folder of a set or a training, or a .safetensors file", positional=True)
        address: str = option("folder or address that gets the copy", positional=True, address=True)
        replace: bool = option("replace another set or network at the address (default: refuse)", False)
        sizes_only: bool = option("compare files at the address by size alone, without reading them back", False)

    @staticmethod
    def run(options: Options) -> int:
        """Copy, and print one line on what was copied."""
        if (options.what / MANIFEST_NAME).exists():
            folder = options.what
            bundle = transfer.set_bundle(LocalFolder(folder))
        else:
            weights = network_file(options.what)
            folder = weights.parent
            bundle = _network_bundle(LocalFolder(folder), weights.name)
        store, pattern = open_store(options.address)
        if pattern != "*":
            raise BadConfig(f"a copy needs the address of a folder, found {pattern!r} at its end")
        target: transfer.Target
        if isinstance(store, RemoteFolder):
            target = transfer.RemoteTarget(store, folder)
        else:
            target = transfer.LocalTarget(Path(store.name), LocalFolder(folder))
        _copy(bundle, target, "pushing", options.replace, options.sizes_only)
        return 0


class Pull:
    EXAMPLE = "bodyseg pull https://host/shards shards"

    @dataclass(frozen=True)
    class Options:
        address: str = option(
            "address of a set, of a training's folder or of a .safetensors file", positional=True, address=True
        )
        folder: Path = option("folder that gets the copy", positional=True)
        replace: bool = option("replace another set or network in the folder (default: refuse)", False)

    @staticmethod
    def run(options: Options) -> int:
        """Copy, and print one line on what was copied."""
        store, bundle = _bundle_at(options.address)
        _copy(bundle, transfer.LocalTarget(options.folder, store), "pulling", options.replace)
        return 0


def network_file(path: Path) -> Path:
    """Return the .safetensors file of a training's folder, or the path if it is one. Raises BadConfig."""
    file = path / RunFiles.NETWORK if path.is_dir() else path
    if path.is_dir() and file.exists() and RunFiles.unfinished(path):
        carry_on = f"carry it on by --resume, or name {file}, an earlier one"
        raise BadConfig(f"the training in {path} has not ended, so that its network is not there yet: {carry_on}")
    if file.suffix != ".safetensors" or not file.is_file():
        raise BadConfig(
            f"neither a set of shards nor a trained network: {path} (no manifest.json, no {RunFiles.NETWORK})"
        )
    return file


def page_file(path: Path) -> Path:
    """Return the file of the page: README.md of a training's folder, NAME.md beside NAME.safetensors."""
    return path / "README.md" if path.is_dir() else path.with_suffix(".md")


def _bundle_at(address: str) -> tuple[Store, transfer.Bundle]:
    """Open the store at an address, and find the set or network there."""
    path, mark, query = address.partition("?") if address.startswith(("http://", "https://")) else (address, "", "")
    weights = path.rpartition("/")[2] if path.endswith(".safetensors") else ""
    if weights:
        parent = path.rpartition("/")[0] if "/" in path else "."
        store, _ = open_store(f"{parent}{mark}{query}")
        return store, _network_bundle(store, weights)
    store, pattern = open_store(address)
    if pattern != "*":
        raise BadConfig(f"a whole set is copied, found {pattern!r} at the end of its address")
    if transfer.pages_of(store, (Path(RunFiles.NETWORK).with_suffix(".json").name,)):
        return store, _network_bundle(store, RunFiles.NETWORK)
    return store, transfer.set_bundle(store)


def _network_bundle(store: Store, weights: str) -> transfer.Bundle:
    """Return the bundle of a network: weights, page and confusion matrix, card.

    weights: name of its file in the store. Raises BadConfig if its card cannot vouch for them, OSError or Unreachable.
    """
    file = Path(weights)
    index = file.with_suffix(".json").name
    data = transfer.read_page(store, index)
    card = parse_json(data, f"{store.name}/{index}")
    digest = card.get(CardWords.WEIGHTS_SHA256)
    if card.get("format") != CardWords.FORMAT or not isinstance(digest, str):
        raise BadConfig(f"{store.name}/{index} is no card of a network with {CardWords.WEIGHTS_SHA256!r}")
    page = "README.md" if weights == RunFiles.NETWORK else page_file(file).name
    scores = confusion_file(file).name
    pages = transfer.pages_of(store, (page, scores))
    return transfer.Bundle((transfer.SharedFile(weights, store.size(weights), digest),), index, data, pages, (scores,))


def _copy(
    bundle: transfer.Bundle, target: transfer.Target, title: str, replace: bool, sizes_only: bool = False
) -> None:
    """Copy a bundle with progress, and say what was done."""
    with Progress(title, "MB") as progress:
        total = round(bundle.size / 1e6)
        outcome = transfer.transfer(
            bundle, target, lambda done: progress.update(min(round(done / 1e6), total), total), replace, sizes_only
        )
    files = "1 file" if outcome.files == 1 else f"{outcome.files} files"
    sys.stdout.write(
        f"{target.store.name}: {files} and {bundle.index}, {bundle.size / 1e6:.1f} MB: {outcome.kept} were there, "
        f"{outcome.copied_bytes / 1e6:.1f} MB copied\n"
    )
