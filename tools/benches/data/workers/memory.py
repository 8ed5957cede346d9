"""Memory of a process and all that it has started, from Linux's /proc."""

from __future__ import annotations

from pathlib import Path

_COUNTED = ("Pss_Anon:", "Pss_Shmem:")


def process_tree(root: int) -> list[int]:
    """Process `root` and all processes below it; those that end meanwhile are left out."""
    parents: dict[int, int] = {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                text = (folder / "stat").read_text()
            except OSError:
                continue
            # Field 4; the name in brackets before it may hold blanks.
            parents[int(folder.name)] = int(text.rpartition(")")[2].split()[1])
    found = [root]
    for process in found:
        found += [child for child, parent in parents.items() if parent == process]
    return found


def tree_mb(root: int) -> float | None:
    """Memory of a process tree, MB: anonymous and shared pages, each counted once; None where /proc does not tell.

    Pages of files, such as those of libraries, are left out: they are the same with any workers, and can be dropped.
    """
    kb = 0
    for process in process_tree(root):
        try:
            text = Path(f"/proc/{process}/smaps_rollup").read_text()
        except OSError:
            if process == root:
                return None
            continue
        kb += sum(int(line.split()[1]) for line in text.splitlines() if line.startswith(_COUNTED))
    return kb / 1024
