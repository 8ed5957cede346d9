"""`bench reliability`: the promises of docs/reference/reliability.md at full length: damage, hostile input, faults."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

from benches.fuzzing.damage import BLOCK, Damaged, Tally, cut_everywhere, flip_bits, mangle
from benches.fuzzing.fuzzing import campaign
from benches.fuzzing.interruptions import TROUBLES, Interrupted, kill_at_instants
from benches.measuring import counter
from bodyseg_data.core import ProgressCallback, silent
from bodyseg_data.packing import Packing, pack
from bodyseg_data.samples import ViewGrid
from bodyseg_data.shards import MANIFEST_NAME

FLIPS: Final = 1000
MANGLES: Final = 450
KILLS: Final = 20

_SEED: Final = 0
_SHARES: Final = {
    "bsi": 0.22,
    "png": 0.15,
    "sample": 0.2,
    "tar": 0.15,
    "manifest": 0.1,
    "index": 0.03,
    "column": 0.02,
    "renders": 0.01,
    "rig": 0.02,
    "landmarks": 0.03,
    "lnd": 0.01,
    "ply": 0.03,
    "scenes": 0.01,
    "recording": 0.02,
}
"""Share of the inputs that each reader gets: most for the readers of files that come from elsewhere."""

_LOOPS: Final = ("bsi", "sample")
"""Readers that have compiled and NumPy loops, whose outcomes must be the same."""

_PIECE: Final = 5000
_DAMAGED: Final = Packing("open", meshes=2, views=ViewGrid(count=3), shard_samples=3)
_INTERRUPTED: Final = Packing("open", meshes=4, views=ViewGrid(count=2), shard_samples=3)


def bench_reliability(views: int = 100_000, progress: ProgressCallback = silent) -> dict[str, Any]:
    """Do everything once and count; `views`: hostile inputs in all. `faults` is how many promises were broken.

    damage: of every file of a small set of the open source. fuzzing: by reader. interruptions: of packings.
    """
    pieces = list(_pieces(views))
    step = counter(progress, 4 + len(pieces) + len(TROUBLES) + KILLS)
    with tempfile.TemporaryDirectory() as folder:
        damage = measure_damage(Path(folder), step)
    fuzzing: dict[str, Any] = {}
    for target, numbers in pieces:
        _add(fuzzing.setdefault(target, {}), by_all_loops(target, numbers))
        step()
    with tempfile.TemporaryDirectory() as folder:
        interruptions = measure_interruptions(Path(folder), step)
    parts = [*damage.values(), *fuzzing.values(), *interruptions.values()]
    return {
        "faults": sum(len(part["faults"]) for part in parts),
        "damages": sum(part["damages"] for part in damage.values()),
        "inputs": sum(part["inputs"] for part in fuzzing.values()),
        "damage": damage,
        "fuzzing": {"seed": _SEED, **fuzzing},
        "interruptions": interruptions,
    }


def measure_damage(folder: Path, step: Callable[[], None]) -> dict[str, dict[str, Any]]:
    """Damage every file of a small set in all ways and count by kind; step: called after each kind."""
    with ThreadPoolExecutor(1) as executor:
        pack(_DAMAGED, folder / "whole", executor, 1)
    damaged = Damaged(folder / "whole", folder / "damaged")

    def cut_shards(tally: Tally) -> None:
        for shard in damaged.manifest.shards:
            cut_everywhere(damaged, shard.name, BLOCK, tally)

    kinds: dict[str, Callable[[Tally], None]] = {
        "shards cut at every block": cut_shards,
        "manifest cut at every byte": lambda tally: cut_everywhere(damaged, MANIFEST_NAME, 1, tally),
        "one bit flipped": lambda tally: flip_bits(damaged, FLIPS, _SEED, tally),
        "bytes lost, put in, zeroed, exchanged": lambda tally: mangle(damaged, MANGLES, _SEED, tally),
    }
    figures = {}
    for name, damage in kinds.items():
        tally = Tally()
        damage(tally)
        figures[name] = tally.figures()
        step()
    return figures


def _pieces(inputs: int) -> list[tuple[str, range]]:
    """(target, numbers of the inputs), in pieces that a process reads in seconds."""
    pieces = []
    for target, share in _SHARES.items():
        count = round(inputs * share)
        pieces += [(target, range(start, min(start + _PIECE, count))) for start in range(0, count, _PIECE)]
    return pieces


def by_all_loops(target: str, numbers: range) -> dict[str, Any]:
    """A campaign; where loops may be compiled, one by each kind, and a fault if what they read differs."""
    if target not in _LOOPS or not find_spec("numba"):
        figures = campaign(target, _SEED, numbers)
        del figures["outcome"]
        return figures
    ways = [campaign(target, _SEED, numbers, kernels) for kernels in ("numpy", "compiled")]
    outcomes = {figures.pop("outcome") for figures in ways}
    total: dict[str, Any] = {}
    for figures in ways:
        _add(total, figures)
    total |= {name: total[name] // 2 for name in ("inputs", "read", "refused") if name in total}
    if len(outcomes) > 1:
        total["faults"] = [*total["faults"], f"compiled loops read inputs {numbers} otherwise than NumPy's"]
    return total


def _add(total: dict[str, Any], part: dict[str, Any]) -> None:
    for name, value in part.items():
        if name in ("longest_s", "memory_of_allowed"):
            total[name] = max(total.get(name, 0), value)
        else:
            total[name] = total[name] + value if name in total else value


def measure_interruptions(folder: Path, step: Callable[[], None]) -> dict[str, dict[str, Any]]:
    """Interrupt packings in all ways and count by kind; step: called after each kind, and after each kill."""
    interrupted = Interrupted(_INTERRUPTED, folder)
    figures: dict[str, dict[str, Any]] = {}
    for trouble in TROUBLES:
        wrong = [fault for n in range(1, interrupted.operations + 1) for fault in interrupted.at(trouble, n)]
        figures[f"{trouble} at every operation"] = {"interruptions": interrupted.operations, "faults": wrong}
        step()
    (folder / "kills").mkdir()
    figures["killed with its workers"] = kill_at_instants(folder / "kills", KILLS, _SEED, step)
    return figures
