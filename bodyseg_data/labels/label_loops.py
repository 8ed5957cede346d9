"""Joining labels in place, compiled, where foreground is: most of an image is background."""

from typing import Any

from bodyseg_data.machine import compiled


@compiled
def join_runs(labels: Any, edges: Any, table: Any) -> None:
    """Replace flat labels by their entries of `table` in runs; edges: where each begins and ends, in turn."""
    for run in range(edges.size // 2):
        for i in range(edges[2 * run], edges[2 * run + 1]):
            labels[i] = table[labels[i]]
