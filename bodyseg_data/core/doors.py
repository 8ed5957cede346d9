"""Doors of rooms: public names imported on first use, so that importing stays cheap; and signals put off meanwhile."""

import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from importlib import import_module
from types import CodeType, FrameType, SimpleNamespace
from typing import Any


def lazy_door(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return `__getattr__`, `__dir__` and `__all__` (PEP 562) for the package whose `__init__` calls this.

    Its names are those that the `__init__` imports under `TYPE_CHECKING`; the call stands in the `else` of that, so
    that type checkers see plain imports, and report a name that is not there. Raises ImportError where a compiler has
    dropped the branch of type checkers, as some that make machine code do.
    """
    frame = sys._getframe(1)
    homes = {name: home for name, home in _all_imports(frame.f_code).items() if name not in frame.f_globals}
    if not homes:
        raise ImportError(f"{package} needs its bytecode: the imports under TYPE_CHECKING, which name what it offers")

    def found(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        # Raised while PyTorch is imported, an interrupt can end in C++, which aborts the process.
        with nullcontext() if homes[name] in sys.modules else signals_held(unless_left=True):
            return getattr(import_module(homes[name]), name)

    def listed() -> list[str]:
        return sorted({*frame.f_globals, *homes})

    return found, listed, sorted(name for name in homes if not name.startswith("__"))


def _all_imports(code: CodeType) -> dict[str, str]:
    """Return name -> module of what the code of an `__init__` imports, under `TYPE_CHECKING` too.

    The code runs once more, as type checkers read it and with an import that only takes notes. Unlike a search of the
    source, this works where there is bytecode alone, and needs no parser.
    """
    homes: dict[str, str] = {}

    def note(module: str, _globals: object, _locals: object, names: Sequence[str], _level: int) -> SimpleNamespace:
        noted = dict.fromkeys(names, module)
        homes.update(noted)
        return SimpleNamespace(**noted)  # its TYPE_CHECKING is a text, which is true

    with suppress(Exception):  # where a compiler has left other code than type checkers read
        exec(code, {"__builtins__": {"__import__": note}})
    return homes


@contextmanager
def signals_held(only_first: bool = False, unless_left: bool = False) -> Iterator[None]:
    """Put off the handling of SIGINT and SIGTERM until the context ends, in the main thread.

    only_first: a second signal is handled at once, for contexts that may last. unless_left: not where SIGTERM is left
    to the system: there may be handlers of C, such as rclpy's, that could not be put back. Other threads receive no
    signals, so nothing is put off there.
    """
    left = unless_left and not callable(signal.getsignal(signal.SIGTERM))
    if left or threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []

    def put_off(number: int, frame: FrameType | None) -> None:
        if came and only_first:
            restore()
            handle(came.pop())
        else:
            came.append(number)

    def handle(number: int) -> None:
        if callable(action := before[number]):  # asyncio has heard of the signal, and would of another, too
            action(number, sys._getframe())
        else:
            signal.raise_signal(number)

    def restore() -> None:
        for number, action in before.items():
            signal.signal(number, action)

    # None: a handler of the program that embeds Python, such as Blender; it could not be set again.
    handled = (each for each in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(each) is not None)
    before: dict[int, Any] = {each: signal.signal(each, put_off) for each in handled}
    try:
        yield
    finally:
        restore()
        for late in came:
            handle(late)
