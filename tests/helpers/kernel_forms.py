"""Both forms of a computation: the compiled loops and NumPy's."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final, TypeVar

import pytest
from benches import environment

FORMS: Final = ("compiled", "numpy")

Answer = TypeVar("Answer")


@contextmanager
def computed_by(form: str) -> Iterator[None]:
    """Compute by one of `FORMS`, whatever the environment says."""
    if form == "compiled":
        pytest.importorskip("numba")
    with environment.computed_by(form):
        yield


def by_both(function: Callable[[], Answer]) -> tuple[Answer, Answer]:
    """What a function returns by the compiled loops and by NumPy."""
    with computed_by("compiled"):
        compiled = function()
    with computed_by("numpy"):
        return compiled, function()
