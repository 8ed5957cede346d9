"""Reading ahead: one item at a time, in order, with errors in their places."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from bodyseg_data.core import BadConfig
from bodyseg_model.segmentation.frame_labeller import read_ahead


def test_the_next_item_and_no_other_is_made_beside_the_work_on_this_one() -> None:
    made = [threading.Event() for _ in range(4)]
    threads: set[int] = set()

    def items() -> Iterator[int]:
        for number, event in enumerate(made):
            threads.add(threading.get_ident())
            event.set()
            yield number

    seen = []
    for number in read_ahead(items()):
        seen.append(number)
        assert all(event.wait(10) for event in made[: number + 2]), "the next one is made without being asked for"
        assert not any(event.is_set() for event in made[number + 2 :])
    assert seen == [0, 1, 2, 3]
    assert len(threads) == 1 and threading.get_ident() not in threads
    assert list(read_ahead(())) == []


@pytest.mark.parametrize("kind", [BadConfig, KeyboardInterrupt])
def test_an_error_comes_after_the_items_before_it(kind: type[BaseException]) -> None:
    def items() -> Iterator[int]:
        yield 0
        yield 1
        raise kind("third")

    seen: list[int] = []
    with pytest.raises(kind, match="^third$"):
        seen.extend(read_ahead(items()))
    assert seen == [0, 1]


def test_leaving_early_ends_the_thread() -> None:
    asked = []

    def items() -> Iterator[int]:
        for number in range(9):
            asked.append(number)
            yield number

    before = threading.active_count()
    coming = read_ahead(items())
    assert next(coming) == 0
    coming.close()
    assert threading.active_count() == before and asked in ([0], [0, 1])
