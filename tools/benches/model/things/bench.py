"""`bench things`: whom the score of people finds in made rooms that it was not fitted to, and what it drops.

docs/reference/things.md says how to read the results.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benches.model.chosen import chosen_network
from benches.model.things.rooms import people_and_things
from bodyseg_data.core import ProgressCallback, silent
from bodyseg_model.segmentation import shipped_score


def bench_things(views: int = 240, runs: Sequence[Path] = (), progress: ProgressCallback = silent) -> dict[str, Any]:
    """Measure the shipped score with a network that labels what it leaves: `people_and_things` of `views` rooms.

    runs: the network is in the first of them; without, it is the one that ships.
    """
    network_name, trained = chosen_network(runs)
    return {
        "network": network_name,
        **people_and_things(trained.network, shipped_score(), views, progress),
    }
