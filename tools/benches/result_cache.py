"""Results kept in a file, so that an interrupted run carries on and nothing is measured twice, and the digest of code.

A result is used again for the same subject, query and code: see `ResultCache`. While the digest of the code that
computes a result is the same, the result is. The digest of a module covers the module and all modules of the project
that it imports, directly or not. They are parsed, not imported; comments, docstrings and layout do not count.
"""

from __future__ import annotations

import ast
import contextlib
import fcntl
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
from typing import Any, Final

from bodyseg_data.core import BadConfig
from bodyseg_data.files import read_bytes, read_json, write_json
from bodyseg_model.networks import RunFiles

PACKAGES: Final = ("bodyseg_data", "bodyseg_model")
"""Packages whose modules are followed, besides the packages of the given modules."""

NEUTRAL: Final = frozenset(
    [
        *(
            "PIL",
            "aiohttp",
            "fsspec",
            "safetensors",
            "tqdm",
            "webdataset",
            "zstandard",
        ),  # bytes pass unchanged
        *("llvmlite", "numba"),  # compiled loops compute the same bits as NumPy
        *("cv2", "datasets", "litdata", "pyarrow"),  # compared with, and often absent: results name their versions
    ]
)
"""Libraries whose version, or absence, changes no result."""

_STANDARD: Final = sys.stdlib_module_names
_IMPORTERS: Final = ("import_module", "__import__")
_DOTTED: Final = re.compile(r"[^\W\d]\w*(?:\.[^\W\d]\w*)*")


@cache
def installed_versions() -> Mapping[str, Sequence[str]]:
    """Map the import name of every installed library to its distributions with their versions."""
    return {
        name: sorted(f"{each} {version(each)}" for each in set(distributions))
        for name, distributions in packages_distributions().items()
    }


def code_digest(*modules: str) -> str:
    """`SourceTree.digest` of installed modules, given by full names; sources are read once in a process."""
    return _installed(frozenset([*PACKAGES, *(name.partition(".")[0] for name in modules)])).digest(modules)


class SourceTree:
    """The source files of some packages.

    packages: name -> folder of a package, or name -> file of a single module. versions: of libraries.
    """

    def __init__(
        self,
        packages: Mapping[str, Path],
        versions: Callable[[], Mapping[str, Sequence[str]]] = installed_versions,
    ) -> None:
        self._packages, self._versions = dict(packages), versions
        self._sources: dict[str, _Source] = {}

    def digest(self, modules: Iterable[str]) -> str:
        """Digest of the modules in `imported_by(modules)`, 32 hexadecimal digits.

        It covers their syntax trees, the files that they name with `importlib.resources.files`, and the versions of
        the libraries that they import, except `NEUTRAL` ones: another torch may add in another order, another anny
        may generate other bodies. Raises BadConfig as `imported_by`.
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
        """List `modules`, all modules of the packages that they import, directly or not, and their packages; sorted.

        Imports anywhere in a module count, also in functions. So does a string that is the full name of a module, with
        or without `:attribute`. In a module that calls `import_module` with a computed name, a string also counts if it
        names a module of the same package, or if it ends with a dot and is the prefix of a package's modules. A name
        that is imported from a door (`lazy_door`) is followed to the module that the door gives it from, and to no
        other of the door's room.

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
        path = self._packages[top].joinpath(*rest.split("."))
        files = [path / "__init__.py", path.with_suffix(".py") if rest else path]
        return next((file for file in files if file.is_file()), None)

    def _parse(self, name: str, file: Path) -> _Source:
        package = name if file.name == "__init__.py" else name.rpartition(".")[0]
        try:
            read = _read(_contents(file), package)
        except (SyntaxError, ValueError) as error:
            raise BadConfig(f"cannot parse {file}: {error}") from error
        return _Source(
            syntax=read.syntax,
            modules=frozenset(each for text in read.imported | read.mentioned for each in self._resolve(text)),
            libraries=frozenset(name.partition(".")[0] for name in read.imported) - self._packages.keys() - _STANDARD,
            data=read.data,
        )

    def _resolve(self, name: str) -> Iterator[str]:
        """The module of a full name that may end with attributes; all modules of a package if it ends with a dot."""
        if name.endswith("."):
            file = self._file(name[:-1])
            if file is not None and file.name == "__init__.py":
                yield from (f"{name}{each.stem}" for each in file.parent.iterdir() if each != file)
            return
        attribute = ""
        while name and (file := self._file(name)) is None:
            name, _, attribute = name.rpartition(".")
        if not name:
            return
        yield name
        if attribute and file is not None and file.name == "__init__.py":
            home = _read(_contents(file), name).door.get(attribute)
            if home is not None:
                yield from self._resolve(home)

    def _data_files(self, sources: Iterable[_Source]) -> Iterator[tuple[str, Path]]:
        """Name and path of every data file that `sources` name with `files(PACKAGE)`; Python files are not data."""
        for package, entry in sorted({each for source in sources for each in source.data}):
            file = self._file(package)
            if file is None:
                continue
            path = file.parent / entry
            within = [path] if path.is_file() else path.rglob("*") if entry else path.iterdir()
            for each in within:
                if each.is_file() and each.suffix not in (".py", ".pyc"):
                    yield f"{package}/{each.relative_to(file.parent).as_posix()}", each


@dataclass(frozen=True)
class _Source:
    """A parsed module. syntax: digest of its tree. modules, libraries: imported names. data: (package, entry in it)."""

    syntax: str
    modules: frozenset[str]
    libraries: frozenset[str]
    data: frozenset[tuple[str, str]]


@dataclass(frozen=True)
class _Read:
    """Facts of a module's text alone. syntax, data: as in `_Source`. imported, mentioned: full names; see below. door:
    name -> full name, of a package whose names are imported when they are used.
    """

    syntax: str
    imported: frozenset[str]
    mentioned: frozenset[str]
    data: frozenset[tuple[str, str]]
    door: Mapping[str, str]


_TEXTUAL: Final = ast.parse("from __future__ import annotations").body[0]


@cache
def _read(text: bytes, package: str) -> _Read:
    """Read a module of `package`, once in a process whichever tree it is in. Raises SyntaxError or ValueError."""
    tree = ast.parse(text)
    nodes = list(ast.walk(tree))  # once: it takes as long as parsing
    dropped = _drop_docstrings(nodes)
    if tree.body and not any(isinstance(node, ast.ImportFrom) and node.module == "__future__" for node in tree.body):
        tree.body.insert(0, _TEXTUAL)  # how annotations are kept changes no result
    door = _door(tree, nodes)
    if door:  # which names it has changes no result
        return _Read("", frozenset(), frozenset(), frozenset(), door)
    nodes = [node for node in nodes if node not in dropped]
    return _Read(
        syntax=_hash(ast.dump(tree).encode()),
        imported=frozenset(_imported(nodes, package)),
        mentioned=frozenset(_mentioned(nodes, package)),
        data=frozenset(_data(nodes, package)),
        door={},
    )


def _door(tree: ast.Module, nodes: Sequence[ast.AST]) -> dict[str, str]:
    """Name -> full name of what a package imports when it is used: what it tells type checkers beside `lazy_door`."""
    if not any(_called(node) == "lazy_door" for node in nodes):
        return {}
    guarded = [each for node in tree.body if isinstance(node, ast.If) for each in node.body]
    imports = [each for each in guarded if isinstance(each, ast.ImportFrom)]
    return {alias.name: f"{each.module}.{alias.name}" for each in imports for alias in each.names}


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


def _drop_docstrings(nodes: Sequence[ast.AST]) -> set[ast.AST]:
    """Remove every statement that is only a string from the blocks of its tree, in place; returns what went."""
    dropped: set[ast.AST] = set()
    for node in nodes:
        for block in (getattr(node, name, None) for name in ("body", "orelse", "finalbody")):
            if isinstance(block, list):
                strings = [each for each in block if isinstance(each, ast.Expr) and _text(each.value) is not None]
                dropped.update(strings, (each.value for each in strings))
                block[:] = [each for each in block if each not in dropped]
    return dropped


def _text(node: ast.AST) -> str | None:
    return node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else None


def _imported(nodes: Sequence[ast.AST], package: str) -> Iterator[str]:
    """Full names imported by statements or by `import_module` of a constant; `from a import b` gives a.b."""
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = _absolute("." * node.level + (node.module or ""), package)
            yield from (f"{base}.{alias.name}" for alias in node.names)
        elif (name := _import_call(node)) is not None and (text := _text(name)) is not None:
            yield _absolute(text, package)


def _mentioned(nodes: Sequence[ast.AST], package: str) -> Iterator[str]:
    """Strings that may be full names of modules or of their attributes; see `SourceTree.imported_by`."""
    calls = [name for node in nodes if (name := _import_call(node)) is not None]
    computed = any(_text(name) is None for name in calls)
    for node in nodes:
        text = (_text(node) or "").partition(":")[0]
        if _DOTTED.fullmatch(text):
            yield from (text, f"{package}.{text}") if computed else (text,)
        elif computed and _DOTTED.fullmatch(text.removesuffix(".")):
            yield text


def _import_call(node: ast.AST) -> ast.expr | None:
    """The first argument of a call of `import_module`; None for any other node."""
    return node.args[0] if isinstance(node, ast.Call) and node.args and _called(node) in _IMPORTERS else None


def _called(node: ast.AST) -> str:
    """The name of the function or method that a node calls; "" if it is no call."""
    function = node.func if isinstance(node, ast.Call) else None
    return getattr(function, "attr", getattr(function, "id", ""))


def _absolute(name: str, package: str) -> str:
    """Resolve a name that may begin with dots, relative to a package."""
    rest = name.lstrip(".")
    for _ in range(len(name) - len(rest) - 1):
        package = package.rpartition(".")[0]
    return f"{package}.{rest}".rstrip(".") if name != rest else name


def _data(nodes: Sequence[ast.AST], package: str) -> Iterator[tuple[str, str]]:
    """PACKAGE of every call `files(PACKAGE)`, and X if it is followed by `/ "X"`, else ""."""
    below = {node.left: _text(node.right) or "" for node in nodes if isinstance(node, ast.BinOp)}
    for node in nodes:
        if isinstance(node, ast.Call) and _called(node) == "files":
            named = _text(node.args[0]) if node.args else None
            yield named or package, below.get(node, "")


FORMAT: Final = "bodyseg cached results 1"


def network_identity(path: Path) -> dict[str, Any]:
    """Identify a network in a run's folder or a .safetensors file: its kind, its settings, the SHA-256 of its weights.

    Raises BadConfig for a file that is missing or damaged.
    """
    file = path / RunFiles.NETWORK if path.is_dir() else path
    card = read_json(file.with_suffix(".json"))
    weights = hashlib.sha256(read_bytes(file)).hexdigest()
    return {"network": card.get("network"), "settings": card.get("settings"), "weights": weights}


class ResultCache:
    """Results about one subject, in one JSON file that several processes may share.

    subject: measured object, as JSON, such as `network_identity`; when it changes, the file starts empty. modules: full
    names of the modules that measure; results become invalid when a module, or any that it imports, changes
    (`code_digest`). The file has one result for each query, so it does not grow as code changes.
    """

    def __init__(self, file: Path, subject: Mapping[str, Any], *modules: str) -> None:
        self._file = file
        self._subject = _as_json(subject)
        self._modules = sorted(set(modules))
        self._code = code_digest(*self._modules)

    def get(self, query: Mapping[str, Any]) -> dict[str, Any] | None:
        """Get the result of a query; None if it is missing, altered, or of other code.

        query: everything that the result depends on besides subject and code, as JSON. Raises BadConfig for a file of
        another format.
        """
        key, query = self._key(query)
        entry = self._read().get(key)
        if not isinstance(entry, dict) or entry != self._entry(query, entry.get("result")):
            return None
        result: dict[str, Any] = entry["result"]
        return result

    def put(self, query: Mapping[str, Any], result: Mapping[str, Any]) -> None:
        """Store a result, JSON without NaN, and keep results that other processes have stored meanwhile.

        Raises BadConfig if the file cannot be written or has another format.
        """
        key, query = self._key(query)
        entry = self._entry(query, _as_json(result))
        with self._locked():
            results = self._read() | {key: entry}
            write_json(self._file, {"format": FORMAT, "subject": self._subject, "results": results})

    def _key(self, query: Mapping[str, Any]) -> tuple[str, Any]:
        """The key of a query, and the query as JSON would return it."""
        query = _as_json(query)
        return json_digest([self._modules, query]), query

    def _entry(self, query: Any, result: Any) -> dict[str, Any]:
        facts = {"query": query, "modules": self._modules, "code": self._code, "result": result}
        return {**facts, "digest": json_digest(facts)}

    def _read(self) -> dict[str, Any]:
        if not self._file.exists():
            return {}
        content = read_json(self._file)
        results = content.get("results")
        if content.get("format") != FORMAT or not isinstance(results, dict):
            raise BadConfig(f"{self._file} holds no results of the format {FORMAT!r}: move it away")
        return results if content.get("subject") == self._subject else {}

    @contextlib.contextmanager
    def _locked(self) -> Iterator[None]:
        """Hold a lock file beside the cache; the system releases it if this process is killed."""
        path = self._file.with_name(f".{self._file.name}.lock")
        with contextlib.ExitStack() as stack:
            try:
                lock = stack.enter_context(path.open("ab"))
                fcntl.flock(lock, fcntl.LOCK_EX)
            except OSError as error:
                raise BadConfig(f"cannot lock {path}: {error.strerror or error}") from error
            try:
                yield
            finally:
                fcntl.flock(lock, fcntl.LOCK_UN)  # closing does not release it while a forked process has it open


def _as_json(value: Any) -> Any:
    """Round trip through JSON. Raises ValueError for NaN, which does not equal itself."""
    return json.loads(json.dumps(value, allow_nan=False))


def json_digest(value: Any) -> str:
    """Digest of a value as JSON, keys in alphabetical order, 32 hexadecimal digits."""
    return hashlib.blake2b(json.dumps(value, sort_keys=True).encode(), digest_size=16).hexdigest()
