"""`bench people`: landmarks and labels of real people, whose landmarks were annotated, in any folder of their meshes.

docs/how-to/landmarks.md says how to read the results.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from benches.landmarks.fitting_body import fitting_body
from benches.model.chosen import chosen_network
from benches.model.people.bodies import annotated_bodies
from benches.model.people.landmarks import fitted_to, measured, proposed, ways_to_place
from benches.model.people.scores import VARIANTS, agreement, packed_views, scored
from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.machine import torch_threads

POSES: Final = 10
"""Meshes of one person in a folder without sub-folders."""


def bench_people(
    data: str,
    views: int = 6,
    runs: Sequence[Path] = (),
    poses: int = POSES,
    alone: bool = False,
    flip_average: bool = False,
    progress: ProgressCallback = silent,
) -> dict[str, Any]:
    """Measure proposed landmarks against annotated ones, and a network on views of the same bodies.

    data: folder of meshes with landmarks, see `annotated_bodies`. views: of each body, all round at the paper's
    distances. runs: the network is in the first of them; without, it is the one that ships. poses: meshes of each
    person. alone: the network's scores alone. flip_average: the network as `FlipAverage`. Raises BadConfig, BadMesh or
    BadLandmarks for a folder without annotated bodies or with one that cannot be read; otherwise as `fit_body` and
    `pack`.
    """
    network_name, trained = chosen_network(runs, flip_average)
    bodies = annotated_bodies(Path(data), poses)
    images = len(VARIANTS) * views * len(bodies)
    steps = images + (0 if alone else len(bodies))
    results: dict[str, Any] = {
        "network": network_name,
        "bodies": len(bodies),
        "people": len({body.person for body in bodies}),
        "views": views,
    }
    if not alone:
        with torch_threads(1):
            open_body = fitting_body()
            fits = []
            for number, body in enumerate(bodies, start=1):
                fits.append(fitted_to(open_body, body))
                progress(number, steps)
            ways = ways_to_place(fits, open_body)
            results["landmarks"] = measured(fits, ways)
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder)
        keys = packed_views(bodies, views, home)
        if not alone:
            results["labels_of_fits"] = {}
            for way, pairs in ways.items():
                by_name = proposed(pairs)
                packed_views([by_name[body.name] for body in bodies], views, home / way)
                results["labels_of_fits"][way] = agreement(home, home / way, keys)
        results["scores"] = scored(trained.network, home, keys, lambda done, _: progress(steps - images + done, steps))
    return results
