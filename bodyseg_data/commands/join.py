"""`bodyseg join`: one set of the parts that several writers have written."""

import sys
from dataclasses import dataclass
from pathlib import Path

from bodyseg_data.commands.options import option
from bodyseg_data.commands.progress import Progress
from bodyseg_data.packing import join

EXAMPLE = "bodyseg join parts --out shards"


@dataclass(frozen=True)
class Options:
    parts: tuple[Path, ...] = option("folders of the parts, or one that holds all parts of a set", positional=True)
    out: Path = option("folder for the set")
    shard_samples: int = option("samples a shard", 1080)


def run(options: Options) -> int:
    """Join the parts and print a line on the set."""
    with Progress("joining", "samples") as progress:
        manifest = join(options.parts, options.out, options.shard_samples, progress.update)
    sys.stdout.write(f"{options.out}: {manifest.counts}\n")
    return 0
