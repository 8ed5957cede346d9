"""The Croissant file of a set: what it is, its shards with their checksums, and the records in them.

Written by the specification of Croissant 1.1 (https://docs.mlcommons.org/croissant/docs/croissant-spec-1.1.html). A
record set holds one member of the samples of one split, since the members are files in tars: `train-bsi` the image
files, `train-json` the descriptions. Records of a sample share their `key`.
"""

import json
from typing import Any, Final

from benches.cards.facts import (
    MEMBERS,
    UNKNOWN_LICENCE,
    Publication,
    SetFacts,
    bodies_text,
    limits_text,
    people_text,
    summary_text,
)
from bodyseg_data.labels import PARTS
from bodyseg_data.samples import Split
from bodyseg_data.shards import CODECS

CROISSANT: Final = "http://mlcommons.org/croissant/1.1"

DIGEST_PREFIX: Final = "sha256:"
"""Before the manifest's digest, in the file's `identifier`."""

_TERMS: Final = (
    "arrayShape citeAs column containedIn equivalentProperty extract field fileProperty source subField transform "
    "fileObject fileSet format includes isArray isLiveDataset jsonPath key md5 parentField path recordSet references "
    "regex repeated replace samplingRate separator"
)
_CONTEXT: Final[dict[str, Any]] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "dct": "http://purl.org/dc/terms/",
    **{name: f"cr:{name}" for name in _TERMS.split()},
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "description": {"@container": "@language"},
    "name": {"@container": "@language"},
}

_FORMATS: Final = {"json": "application/json", "png": "image/png"}
_KEY_PATTERN: Final = r"^([^.]+)[.].*$"


def croissant(facts: SetFacts, publication: Publication) -> dict[str, Any]:
    """Return the content of a set's Croissant file as plain JSON."""
    members = [*CODECS[facts.manifest.codec].members, "json"]
    bodies = bodies_text(facts)
    return {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": [CROISSANT, "http://mlcommons.org/croissant/RAI/1.0"],
        "name": publication.title,
        "description": " ".join([summary_text(facts), *bodies]),
        **_licence(publication.licence),
        **({"creator": {"@type": "sc:Person", "name": publication.author}} if publication.author else {}),
        **({"url": publication.url} if publication.url else {}),
        "datePublished": publication.published.isoformat(),
        "version": facts.version,
        "identifier": f"{DIGEST_PREFIX}{facts.manifest.digest}",
        "citeAs": ", ".join([*filter(None, [publication.author]), publication.title, f"version {facts.version}"]),
        "keywords": ["range image", "depth", "segmentation", "structured light", "webdataset"],
        "rai:dataCollection": " ".join(
            [f"Rendered by {facts.manifest.renderer}, rig {facts.manifest.rig.name}.", *bodies]
        ),
        "rai:dataLimitations": limits_text(facts),
        **({"rai:personalSensitiveInformation": people_text(facts)} if facts.of_bodies else {}),
        "distribution": [*_files(facts, publication), *_file_sets(facts, members)],
        "recordSet": [
            *(_records(split, member) for split in facts.splits for member in members),
            _classes(facts),
        ],
    }


def croissant_bytes(facts: SetFacts, publication: Publication) -> bytes:
    """Return the Croissant file; the same facts give the same bytes."""
    return (json.dumps(croissant(facts, publication), indent=1) + "\n").encode()


def _licence(licence: str) -> dict[str, str]:
    if licence == UNKNOWN_LICENCE:
        return {}
    plain = all(letter.isalnum() or letter in ".-+" for letter in licence)
    return {"license": f"https://spdx.org/licenses/{licence}.html" if plain else licence}


def _files(facts: SetFacts, publication: Publication) -> list[dict[str, Any]]:
    base = f"{publication.url.rstrip('/')}/" if publication.url else ""
    return [
        {
            "@type": "cr:FileObject",
            "@id": file.name,
            "name": file.name,
            "contentUrl": f"{base}{file.name}",
            "contentSize": f"{file.size} B",
            "encodingFormat": "application/octet-stream" if file is facts.manifest.index else "application/x-tar",
            "sha256": file.sha256,
        }
        for file in (*facts.manifest.shards, *(() if facts.manifest.index is None else (facts.manifest.index,)))
    ]


def _file_sets(facts: SetFacts, members: list[str]) -> list[dict[str, Any]]:
    return [
        {
            "@type": "cr:FileSet",
            "@id": f"{split}-{member}-files",
            "name": f"{split}-{member}-files",
            "description": f"Members NAME.{member} of the shards of the split {split}.",
            "containedIn": [{"@id": shard.name} for shard in facts.manifest.shards if shard.split == split],
            "encodingFormat": _FORMATS.get(member.rpartition(".")[2], "application/octet-stream"),
            "includes": f"*.{member}",
        }
        for split in facts.splits
        for member in members
    ]


def _records(split: Split, member: str) -> dict[str, Any]:
    """One record a sample: its key, and one of its members as it is stored, a PNG as an image."""
    name = f"{split}-{member}"

    def source(file_property: str, **transform: Any) -> dict[str, Any]:
        return {"fileSet": {"@id": f"{name}-files"}, "extract": {"fileProperty": file_property}, **transform}

    return {
        "@type": "cr:RecordSet",
        "@id": name,
        "name": name,
        "description": f"Samples of the split {split}, in the order of their keys: {MEMBERS[member]}.",
        "key": {"@id": f"{name}/key"},
        "field": [
            {
                "@type": "cr:Field",
                "@id": f"{name}/key",
                "name": f"{name}/key",
                "description": "Key of the sample, which names body and view.",
                "dataType": "sc:Text",
                "source": source("filename", transform={"regex": _KEY_PATTERN}),
            },
            {
                "@type": "cr:Field",
                "@id": f"{name}/content",
                "name": f"{name}/content",
                "description": MEMBERS[member],
                "dataType": "sc:ImageObject" if member.endswith(".png") else "sc:Text",
                "source": source("content"),
            },
        ],
    }


def _classes(facts: SetFacts) -> dict[str, Any]:
    """The 33 parts, or the classes of any other set: a record set that stands in the file itself, its key the label."""
    rows: list[dict[str, Any]]
    if facts.of_bodies:
        of, description = "parts", "The parts, each the surface nearest to one landmark; sides are the subject's own."
        rows = [{"label": part.label, "landmark": part.landmark, "side": part.side} for part in PARTS]
    else:
        of, description = "classes", f"The classes {facts.manifest.classes.name}."
        rows = [{"label": label, "name": name} for label, name in enumerate(facts.manifest.classes.names)]
    kinds = {int: "sc:Integer", str: "sc:Text"}
    return {
        "@type": "cr:RecordSet",
        "@id": of,
        "name": of,
        "description": description,
        "key": {"@id": f"{of}/label"},
        "field": [
            {"@type": "cr:Field", "@id": f"{of}/{name}", "name": f"{of}/{name}", "dataType": kinds[type(value)]}
            for name, value in rows[0].items()
        ],
        "data": [{f"{of}/{name}": value for name, value in row.items()} for row in rows],
    }
