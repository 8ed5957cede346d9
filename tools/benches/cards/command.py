"""`tools/card`: write the cards of a set or a network beside it."""

import sys
from dataclasses import dataclass
from datetime import UTC, date, datetime
from pathlib import Path

from benches.cards.croissant import croissant_bytes
from benches.cards.dataset_cards import dataset_card
from benches.cards.facts import UNKNOWN_LICENCE, Publication, set_facts
from bodyseg_data.commands import option
from bodyseg_data.core import BadConfig
from bodyseg_data.files import write_result
from bodyseg_data.shards import MANIFEST_NAME, read_manifest
from bodyseg_data.transfer.transfers import CARD_NAMES

EXAMPLE = 'tools/card shards --licence CC0-1.0 --author "A. Author"'


@dataclass(frozen=True)
class Options:
    what: Path = option("folder of a set, folder of a training, or a .safetensors file", positional=True)
    title: str | None = option("title of the set or network (default: the folder's or file's name)", None)
    licence: str = option("its licence: an SPDX identifier like CC0-1.0, an address or a sentence", UNKNOWN_LICENCE)
    author: str = option("who publishes it", "")
    url: str = option("http address of the folder that will hold the set; Croissant then names its shards there", "")
    date: str | None = option("date of publication, YYYY-MM-DD (default: today)", None)


def run(options: Options) -> int:
    """Write the cards and name them."""
    title = options.title or options.what.absolute().name.removesuffix(".safetensors")
    publication = Publication(title, _day(options.date), options.licence, options.author, options.url)
    if (options.what / MANIFEST_NAME).exists():
        files = _set_cards(options.what, publication)
    else:
        files = _network_card(options.what, publication)
    held = [str(path) for path, data in files.items() if path.is_file() and path.read_bytes() != data]
    if held:
        raise BadConfig(f"written already, perhaps by hand: {', '.join(held)}: delete to write anew")
    for path, data in files.items():
        write_result(path, data)
        sys.stdout.write(f"wrote {path}\n")
    return 0


def _set_cards(folder: Path, publication: Publication) -> dict[Path, bytes]:
    facts = set_facts(read_manifest(folder))
    written = croissant_bytes(facts, publication), dataset_card(facts, publication).encode()
    return {folder / name: data for name, data in zip(CARD_NAMES, written, strict=True)}


def _network_card(path: Path, publication: Publication) -> dict[Path, bytes]:
    from benches.cards.model_cards import model_card
    from bodyseg_model.commands.sharing import network_file, page_file

    if publication.url:
        raise BadConfig("--url is where a set will be, and its shards: the page of a network names no address")
    weights = network_file(path)
    return {page_file(path): model_card(weights, publication).encode()}


def _day(text: str | None) -> date:
    try:
        return datetime.now(UTC).date() if text is None else date.fromisoformat(text)
    except ValueError:
        raise BadConfig(f"--date must be a day like 2026-01-31, found {text!r}") from None
