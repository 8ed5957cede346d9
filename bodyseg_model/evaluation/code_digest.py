"""A digest of the code that computes a result: as long as it stays, so does the result.

The code of a module is all modules of the project that it imports, directly or not, and itself. They are parsed, not
imported; comments, docstrings and layout do not count.
"""

from __future__ import annotations

import ast
import hashlib
import json
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import packages_distributions, version
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from bodyseg_data.core.errors import BadConfig

PACKAGES: Final = ("bodyseg_data", "bodyseg_model")
"""The project's packages, whose modules are followed; so are those of the packages that the given modules are in."""

NEUTRAL: Final = frozenset(
    [
        *("PIL", "aiohttp", "fsspec", "safetensors", "tqdm", "webdataset", "zstandard"),  # bytes come as they went
        *("llvmlite", "numba"),  # compiled loops give NumPy's bits
    ]
)
"""Libraries of which another version, or none, changes no result."""

_STANDARD: Final = sys.stdlib_module_names
_IMPORTERS: Final = ("import_module", "__import__")
_DOTTED: Final = re.compile(r"[^\W\d]\w*(?:\.[^\W\d]\w*)*")


@cache
def installed_versions() -> Mapping[str, Sequence[str]]:
    """Name of an installed library, as it is imported -> its distributions with their versions."""
    return {
        name: sorted(f"{each} {version(each)}" for each in set(distributions))
        for name, distributions in packages_distributions().items()
    }


def code_digest(*modules: str) -> str:
    """`SourceTree.digest` of installed modules, given by their full names, as they were when first asked about."""
    return _installed(frozenset([*PACKAGES, *(name.partition(".")[0] for name in modules)])).digest(modules)


class SourceTree:
    """The source files of some packages, each parsed once.

    packages: name of a package or of a module outside packages -> the folder of the one, the file of the other.
    versions: of libraries.
    """

    def __init__(
        self,
        packages: Mapping[str, Path],
        versions: Callable[[], Mapping[str, Sequence[str]]] = installed_versions,
    ) -> None:
        self._packages, self._versions = dict(packages), versions
        self._sources: dict[str, _Source] = {}

    def digest(self, modules: Iterable[str]) -> str:
        """A digest of `imported_by(modules)`, 32 hexadecimal digits.

        It covers their syntax trees, the files that they name with `importlib.resources.files`, and the versions of
        the libraries that they import, `NEUTRAL` aside: another torch may add in another order, another anny may
        make other bodies. Raises BadConfig as `imported_by`.
        """
        sources = {name: self._sources[name] for name in self.imported_by(modules)}
        libraries = {each for source in sources.values() for each in source.libraries} - NEUTRAL
        facts = {
            "modules": {name: source.syntax for name, source in sources.items()},
            "files": {name: _hash(_contents(file)) for name, file in self._data_files(sources.values())},
            "libraries": {name: self._versions().get(name) for name in libraries},
        }
        return _hash(json.dumps(facts, sort_keys=True).encode())

    def imported_by(self, modules: Iterable[str]) -> list[str]:
        """`modules`, all that they import of the packages, directly or not, and the packages these are in; sorted.

        An import counts wherever it stands, in a function as well. So does a string that is the full name of a module,
        with or without `:attribute`; and in a module that calls `import_module` with a name that it computes, a string
        that names a module of the same package, or the beginning, up to a dot, of the names of a package's modules.

        Raises BadConfig for one of `modules` that has no source here, or a source that cannot be parsed.
        """
        waiting = list(modules)
        for name in waiting:
            if self._file(name) is None:
                raise BadConfig(f"the module {name!r} has no source here, by which to tell whether it has changed")
        found: set[str] = set()
        while waiting:
            name = waiting.pop()
            if name in found or (file := self._file(name)) is None:
                continue
            found.add(name)
            if name not in self._sources:
                self._sources[name] = self._parse(name, file)
            waiting += self._sources[name].modules
            waiting += (name[:dot] for dot, letter in enumerate(name) if letter == ".")
        return sorted(found)

    def _file(self, name: str) -> Path | None:
        """The source of a module; None if there is none, as for a folder without `__init__.py`."""
        top, _, rest = name.partition(".")
        if top not in self._packages:
            return None
        place = self._packages[top].joinpath(*rest.split("."))
        files = [place / "__init__.py", place.with_suffix(".py") if rest else place]
        return next((file for file in files if file.is_file()), None)

    def _parse(self, name: str, file: Path) -> _Source:
        try:
            tree = ast.parse(_contents(file))
        except (SyntaxError, ValueError) as error:
            raise BadConfig(f"cannot parse {file}: {error}") from error
        _drop_docstrings(tree)
        package = name if file.name == "__init__.py" else name.rpartition(".")[0]
        nodes = list(ast.walk(tree))
        imported, mentioned = set(_imported(nodes, package)), set(_mentioned(nodes, package))
        return _Source(
            syntax=_hash(ast.dump(tree).encode()),
            modules=frozenset(each for known in imported | mentioned for each in self._meant(known)),
            libraries=frozenset(known.partition(".")[0] for known in imported) - self._packages.keys() - _STANDARD,
            data=frozenset(_data(nodes, package)),
        )

    def _meant(self, name: str) -> Iterator[str]:
        """The module of a full name that may end with attributes; all of a package for one that ends with a dot."""
        if name.endswith("."):
            file = self._file(name[:-1])
            if file is not None and file.name == "__init__.py":
                yield from (f"{name}{each.stem}" for each in file.parent.iterdir() if each != file)
            return
        while name and self._file(name) is None:
            name = name.rpartition(".")[0]
        if name:
            yield name

    def _data_files(self, sources: Iterable[_Source]) -> Iterator[tuple[str, Path]]:
        """Name and path of every file that is no source, in what `sources` name beside the modules of a package."""
        for package, entry in sorted({each for source in sources for each in source.data}):
            file = self._file(package)
            if file is None:
                continue
            place = file.parent / entry
            within = [place] if place.is_file() else place.rglob("*") if entry else place.iterdir()
            for each in within:
                if each.is_file() and each.suffix not in (".py", ".pyc"):
                    yield f"{package}/{each.relative_to(file.parent).as_posix()}", each


@dataclass(frozen=True)
class _Source:
    """A parsed module. syntax: digest of its tree. modules: of the packages. data: package and what is named in it."""

    syntax: str
    modules: frozenset[str]
    libraries: frozenset[str]
    data: frozenset[tuple[str, str]]


@cache
def _installed(names: frozenset[str]) -> SourceTree:
    packages = {}
    for name in names:
        spec = find_spec(name)
        if spec is not None and spec.submodule_search_locations:
            packages[name] = Path(next(iter(spec.submodule_search_locations)))
        elif spec is not None and spec.origin is not None:
            packages[name] = Path(spec.origin)
    return SourceTree(packages)


def _contents(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        raise BadConfig(f"cannot read {file}: {error.strerror or error}") from error


def _hash(data: bytes) -> str:
    return hashlib.blake2b(data, digest_size=16).hexdigest()


def _drop_docstrings(tree: ast.AST) -> None:
    """Every statement that is a string alone goes: it does nothing."""
    for node in ast.walk(tree):
        for block in (getattr(node, name, None) for name in ("body", "orelse", "finalbody")):
            if isinstance(block, list):
                block[:] = [each for each in block if not isinstance(each, ast.Expr) or _text(each.value) is None]


def _text(node: ast.AST) -> str | None:
    return node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else None


def _imported(nodes: Sequence[ast.AST], package: str) -> Iterator[str]:
    """Full names that are imported by statements, or by `import_module` of a constant; of `from a import b`, a.b."""
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = _absolute("." * node.level + (node.module or ""), package)
            yield from (f"{base}.{alias.name}" for alias in node.names)
        elif (name := _import_call(node)) is not None and (text := _text(name)) is not None:
            yield _absolute(text, package)


def _mentioned(nodes: Sequence[ast.AST], package: str) -> Iterator[str]:
    """Full names that strings may be, of modules or of what is in them; see `SourceTree.imported_by`."""
    calls = [name for node in nodes if (name := _import_call(node)) is not None]
    computed = any(_text(name) is None for name in calls)
    for node in nodes:
        text = (_text(node) or "").partition(":")[0]
        if _DOTTED.fullmatch(text):
            yield from (text, f"{package}.{text}") if computed else (text,)
        elif computed and _DOTTED.fullmatch(text.removesuffix(".")):
            yield text


def _import_call(node: ast.AST) -> ast.expr | None:
    """What a call of `import_module` imports; None for anything else."""
    return node.args[0] if isinstance(node, ast.Call) and node.args and _called(node) in _IMPORTERS else None


def _called(node: ast.AST) -> str:
    """The name of the function or method that is called; "" for anything else."""
    function = node.func if isinstance(node, ast.Call) else None
    return getattr(function, "attr", getattr(function, "id", ""))


def _absolute(name: str, package: str) -> str:
    """A name that may begin with dots, as seen from a package."""
    rest = name.lstrip(".")
    for _ in range(len(name) - len(rest) - 1):
        package = package.rpartition(".")[0]
    return f"{package}.{rest}".rstrip(".") if name != rest else name


def _data(nodes: Sequence[ast.AST], package: str) -> Iterator[tuple[str, str]]:
    """The package of every call `files(PACKAGE)`, and X where the call stands in `files(PACKAGE) / "X"`, else ""."""
    below = {node.left: _text(node.right) or "" for node in nodes if isinstance(node, ast.BinOp)}
    for node in nodes:
        if isinstance(node, ast.Call) and _called(node) == "files":
            named = _text(node.args[0]) if node.args else None
            yield named or package, below.get(node, "")
