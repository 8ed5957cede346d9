"""Arrays are checked against the docstrings while tests run: importing this module checks all that is imported later.

A public docstring of the project promises "NAME: uint16 [H, W]" for a parameter or a field of a dataclass, and
"... uint16 [H, W]" in its first paragraph for what a function returns; "uint8 or uint16 [H, W]" allows both. A letter
stands for one length in all promises of a docstring; a number, or the name of a parameter that is one, for itself. A
call that breaks a promise raises `BrokenPromise`. Promises of another form ("[N]" without a type, "[3 * count]") are
for people.
"""

from __future__ import annotations

import functools
import importlib.abc
import importlib.machinery
import inspect
import re
import sys
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, is_dataclass
from typing import Any

_TYPE = r"(?:bool|u?int(?:8|16|32|64)|float(?:32|64))"
_KIND = rf"(?P<kind>{_TYPE}(?: or {_TYPE})*) \[(?P<lengths>[^\]]+)\]"
_NAMED = re.compile(rf"(?P<names>\w+(?:, \w+)*): {_KIND}")
_RETURNED = re.compile(_KIND)
_PROJECT = ("bodyseg_data.", "bodyseg_model.")
_LENGTH = re.compile(r"\d+|[A-Za-z]\w*")
_BY_PLACE = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)


@functools.cache
def _kind(dtype: Any) -> str:
    """The name of an array's or a tensor's type."""
    return str(dtype).removeprefix("torch.")


class BrokenPromise(AssertionError):
    """An array is not what a docstring says it is."""


@dataclass(frozen=True)
class Promise:
    """An array's type and the lengths of its axes."""

    kinds: tuple[str, ...]
    lengths: tuple[str, ...]

    def check(self, what: str, array: Any, known: dict[str, int]) -> None:
        """Compare an array with the promise; known: the lengths seen so far, which this one's are added to."""
        kind, shape = _kind(array.dtype), tuple(map(int, array.shape))
        fits = kind in self.kinds and len(shape) == len(self.lengths)
        if fits:
            for length, found in zip(self.lengths, shape, strict=True):
                fits &= found == (int(length) if length.isdigit() else known.setdefault(length, found))
        if not fits:
            where = ", ".join(f"{name} = {length}" for name, length in known.items())
            wanted = f"{' or '.join(self.kinds)} [{', '.join(self.lengths)}]"
            raise BrokenPromise(f"{what} must be {wanted}, found {kind} {shape}" + (f" where {where}" if where else ""))


def promises(docstring: str | None) -> tuple[dict[str, Promise], Promise | None]:
    """What a docstring promises: by name, and of what is returned (None if nothing, or if that is not clear)."""
    text = re.sub(r"\s+", " ", docstring or "")
    named = {name: made for found in _NAMED.finditer(text) if (made := _promise(found)) for name in _names(found)}
    first = _NAMED.sub("", re.sub(r"\s+", " ", (docstring or "").split("\n\n")[0]))
    returned = [_promise(found) for found in _RETURNED.finditer(first.partition("->")[2] or first)]
    return named, returned[0] if len(returned) == 1 else None


def _names(found: re.Match[str]) -> list[str]:
    return found["names"].split(", ")


def _promise(found: re.Match[str]) -> Promise | None:
    lengths = tuple(found["lengths"].split(", "))
    return Promise(tuple(found["kind"].split(" or ")), lengths) if all(map(_LENGTH.fullmatch, lengths)) else None


def _check(what: str, made: Mapping[str, Promise], values: Mapping[str, Any], known: dict[str, int]) -> None:
    for name, promise in made.items():
        if hasattr(values.get(name), "dtype"):
            promise.check(f"{what}: {name}", values[name], known)


def checked(function: Callable[..., Any], what: str) -> Callable[..., Any]:
    """The function, which raises BrokenPromise where arguments or result differ from its docstring."""
    named, returned = promises(function.__doc__)
    parameters = inspect.signature(function).parameters
    named = {name: promise for name, promise in named.items() if name in parameters}
    if not named and returned is None:
        return function
    places = [name for name, parameter in parameters.items() if parameter.kind in _BY_PLACE]

    @functools.wraps(function)
    def wrapped(*arguments: Any, **options: Any) -> Any:
        values = dict(zip(places, arguments, strict=False)) | options  # a wrong call is refused by the function itself
        known = {name: value for name, value in values.items() if type(value) is int}
        result = function(*arguments, **options)  # first: a function that checks its arguments has messages of its own
        _check(what, named, values, known)
        if returned is not None and hasattr(result, "dtype"):
            returned.check(f"{what} returns what", result, known)
        return result

    return wrapped


def _made_by_the_project() -> bool:
    """Tell objects that the project makes, itself or by `dataclasses.replace`, from what tests make to hand in."""
    frame = sys._getframe(2)
    while frame.f_back is not None and frame.f_globals.get("__name__") in (__name__, "dataclasses"):
        frame = frame.f_back
    return str(frame.f_globals.get("__name__")).startswith(_PROJECT)


def check_class(kind: type, what: str) -> None:
    """Check the public methods of a class and, if it is a dataclass, its fields once it is made.

    Objects with a method `check` of their own are left out: they may be made of input that it is to refuse.
    """
    for name, member in list(vars(kind).items()):
        if isinstance(member, types.FunctionType) and not name.startswith("_"):
            setattr(kind, name, checked(member, f"{what}.{name}"))
    named, _ = promises(kind.__doc__)
    if not named or not is_dataclass(kind) or hasattr(kind, "check"):
        return
    plain: Callable[..., None] = vars(kind)["__init__"]

    @functools.wraps(plain)
    def made(self: Any, *arguments: Any, **options: Any) -> None:
        plain(self, *arguments, **options)
        if _made_by_the_project():
            _check(what, named, {name: getattr(self, name, None) for name in named}, {})

    kind.__init__ = made  # type: ignore[misc]


def check_module(module: types.ModuleType) -> None:
    """Check the public functions and classes that a module defines."""
    for name, member in list(vars(module).items()):
        if name.startswith("_") or getattr(member, "__module__", None) != module.__name__:
            continue
        if isinstance(member, types.FunctionType):
            setattr(module, name, checked(member, f"{module.__name__}.{name}"))
        elif isinstance(member, type):
            check_class(member, f"{module.__name__}.{name}")


def _run_and_check(run: Callable[[types.ModuleType], None], module: types.ModuleType) -> None:
    run(module)
    check_module(module)


class _Finder(importlib.abc.MetaPathFinder):
    def find_spec(
        self, name: str, path: Sequence[str] | None, target: types.ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if not name.startswith(_PROJECT):
            return None
        for finder in _others():
            spec = finder.find_spec(name, path, target)
            if spec is not None and spec.loader is not None:
                spec.loader.exec_module = functools.partial(_run_and_check, spec.loader.exec_module)  # type: ignore[method-assign]
                return spec
        return None


def _others() -> Iterator[Any]:
    return (finder for finder in sys.meta_path if not isinstance(finder, _Finder))


sys.meta_path.insert(0, _Finder())
