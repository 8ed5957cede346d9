"""Reading ahead: the next item is made in a thread while the caller works on this one."""

from __future__ import annotations

from collections.abc import Generator, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Final, TypeVar

_END: Final = object()

Item = TypeVar("Item")


def read_ahead(items: Iterable[Item]) -> Generator[Item, None, None]:
    """Yield items in their order; one thread makes the next while the caller works on this one, and no more than that.

    An error of an item is raised in its place, after all items before it have been yielded. Whoever leaves early waits
    for the item that is being made.
    """
    remaining = iter(items)
    with ThreadPoolExecutor(1, "reading") as thread:
        coming = thread.submit(next, remaining, _END)
        while (item := coming.result()) is not _END:
            coming = thread.submit(next, remaining, _END)
            yield item  # type: ignore[misc]  # all but _END
