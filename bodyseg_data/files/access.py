"""Files: atomic writes, reads of untrusted files up to a limit of bytes, and TOML tables read key by key.

A file or key that is missing, wrong or unknown is one clear line.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import glob
import gzip
import json
import os
import re
import secrets
import shutil
import tomllib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any, Final, TypeVar

from bodyseg_data.core import BadConfig, reported

_LARGEST_FILE: Final = 1 << 31
_LARGEST_JSON: Final = 1 << 26  # objects of Python take twenty times as many bytes
_LARGEST_TOML: Final = 1 << 20
# A key of more than 17 parts: `tomllib` keeps every prefix of a key, 9 GB for one of 50 000 parts.
_DOTTED: Final = re.compile(r"""(?:(?<![\w"'-])(?:[\w-]++|"(?:[^"\\\n]|\\.)*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){17}""")
_CHUNK_BYTES: Final = 1 << 20
_PART: Final = ".part"
_ANY_PART: Final = f".{'[0-9a-f]' * 8}{_PART}"  # a pattern: how all names of `part_beside` end
_LOCK: Final = ".lock"
_OF_WINDOWS: Final = ("desktop.ini", "thumbs.db")

Value = TypeVar("Value")


def write_atomically(path: Path, data: bytes | Iterable[bytes], flushed: bool = True) -> None:
    """Write `data` beside `path`, then rename: `path` never holds a part of it, even after a power cut, and whole files
    alone if several processes write it at once.

    data: all bytes, or chunks of them; an error of their iterator leaves no file. flushed: False does not wait for the
    disk, which may take longer than all else; until `sync` is called, a power cut may then leave an empty file. Raises
    OSError, which names the file, also for a pipe or a device, in whose place a file would be.
    """
    refuse_special(path)
    aside = part_beside(path)
    with naming(path):
        try:
            with aside.open("xb") as file:
                file.writelines((data,) if isinstance(data, bytes) else data)
                if flushed:
                    file.flush()
                    os.fsync(file.fileno())
            aside.replace(path)
        except BaseException:
            with contextlib.suppress(OSError):
                aside.unlink(missing_ok=True)
            raise
        if flushed:
            sync(path.parent)


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Give the system's errors within the context that name no file, as of a disk that is full, the name `path`."""
    try:
        yield
    except OSError as error:
        if error.errno is not None and error.filename is None:
            error.filename = str(path)
        raise


def part_beside(path: Path) -> Path:
    """A name that no other writer takes, beside a file or folder that is renamed to `path` when it is whole: of 255
    bytes at most, as file systems ask, where a letter takes up to four.
    """
    return path.with_name(f".{path.name[:50]}.{secrets.token_hex(4)}{_PART}")


def parts_left(folder: Path) -> Iterator[Path]:
    """Files of `part_beside` that killed processes left in a folder where nobody else is at work."""
    return filter(Path.is_file, folder.glob(f".*{_ANY_PART}"))


@contextlib.contextmanager
def held_part(path: Path, make: Callable[[Path], object]) -> Iterator[Path]:
    """Make the file or folder `part_beside` of `path`, which goes when the context ends unless it was renamed, and
    remove what killed processes left of such ones: they are locked as long as their process lives. Raises OSError.
    """
    for left in path.parent.glob(f".{glob.escape(path.name[:50])}{_ANY_PART}"):
        with contextlib.suppress(OSError), _opened(left) as handle:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            _remove(left)
    part = part_beside(path)
    make(part)
    try:
        with _opened(part) as handle:
            with contextlib.suppress(OSError):  # some file systems have no locks, and then nothing is removed above
                fcntl.flock(handle, fcntl.LOCK_EX)
            yield part
    finally:
        _remove(part)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[int]:
    handle = os.open(path, os.O_RDONLY)
    try:
        yield handle
    finally:
        os.close(handle)


def _remove(path: Path) -> None:
    """Remove a file or a folder with all that is in it, as far as that can be done."""
    with contextlib.suppress(OSError):
        shutil.rmtree(path) if path.is_dir() else path.unlink()


def write_result(path: Path, data: bytes, flushed: bool = True) -> None:
    """Write a file that a user requested, as `write_atomically`. Raises BadConfig, naming it."""
    with reported(f"cannot write {path}", BadConfig, OSError):
        write_atomically(path, data, flushed)


def make_folder(path: Path) -> list[Path]:
    """Make a folder and those above it; returns those that it made, inner ones first. Raises BadConfig, naming it."""
    with reported(f"cannot make the folder {path}", BadConfig, OSError):
        made = [each for each in (path, *path.parents) if not each.exists()]
        if made and made[-1].name.endswith(":") and not path.is_absolute():  # as a path, an address is a folder "s3:"
            raise BadConfig(f"a folder of this machine is needed, found the address {path}")
        path.mkdir(parents=True, exist_ok=True)
    return made


def entries_of(folder: Path) -> list[Path]:
    """Entries of a folder in alphabetical order, without those that systems and programs hide: of a leading dot, as
    macOS's .DS_Store, and Windows's Thumbs.db and desktop.ini. Raises OSError.
    """
    paths = sorted(folder.iterdir())
    return [path for path in paths if not path.name.startswith(".") and path.name.lower() not in _OF_WINDOWS]


def cache_folder() -> Path:
    """`bodyseg` in an absolute XDG_CACHE_HOME, as XDG requires, or in ~/.cache. Raises BadConfig without a home."""
    chosen = Path(os.environ.get("XDG_CACHE_HOME", ""))
    with reported("a cache's folder must be given, by XDG_CACHE_HOME or HOME", BadConfig, RuntimeError):
        return (chosen if chosen.is_absolute() else Path.home() / ".cache") / "bodyseg"


@contextlib.contextmanager
def claimed(folder: Path, work: str) -> Iterator[None]:
    """Hold a folder, made if it is not there, against others who claim it while the context lasts. One that was made,
    and holds nothing at the end, is removed again: what is refused leaves no trace.

    work: what another one does then, for the message. Raises BadConfig if the folder is held, or cannot be written.
    """
    made = make_folder(folder)
    path = folder / _LOCK
    try:
        handle = _locked(path)
    except BlockingIOError:
        raise BadConfig(f"another {work} is at work in {folder}: wait for its end, or give another folder") from None
    except OSError as error:
        raise BadConfig(f"cannot write and lock {path}: {error.strerror or error}") from error
    try:
        yield
    finally:
        try:
            path.unlink(missing_ok=True)
        finally:
            os.close(handle)
        with contextlib.suppress(OSError):  # it holds something
            for each in made:
                each.rmdir()


def _locked(path: Path) -> int:
    """Open a file and lock it. Raises BlockingIOError where another one has, OSError."""
    while True:
        handle = os.open(path, os.O_CREAT | os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(path.lstat(), os.fstat(handle)):
                    return handle
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)  # its holder has just removed it


def last_name(path: str) -> str:
    """Return an address without its user and query, which may be secret, or the last name of a path."""
    plain = path.partition("?")[0] if path.startswith(("http://", "https://")) else path
    return re.sub(r"(?<=://)[^/@]*@", "", plain) if "://" in path else Path(path).name


def natural_key(name: str) -> list[tuple[int, str]]:
    """Sort key that orders numbers in names by value: digits without leading zeros sort by count, then themselves."""
    parts = re.split(r"([0-9]+)", name)
    key = []
    for text, digits in zip(parts[::2], [*parts[1::2], ""], strict=True):
        plain = digits.lstrip("0")
        key += [(0, text), (len(plain), plain)]
    return [*key, (0, name)]


def sync(path: Path) -> None:
    """Wait until the disk holds a file, or a folder's entries, so that renames within it survive a power cut."""
    with _opened(path) as handle:
        try:
            os.fsync(handle)
        except OSError as error:
            if error.errno != errno.EINVAL:  # a file system that cannot sync folders, as one shared with a guest
                raise


def refuse_special(path: Path) -> None:
    """Raise OSError for a pipe, which a reader would wait for without end, a device and the like."""
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise OSError(errno.EINVAL, "not a regular file", str(path))


def parse_json(data: bytes, where: str) -> dict[str, Any]:
    """The object in JSON text; `where` names its origin in messages. Raises BadConfig, also for a key that is twice."""
    try:
        content = json.loads(data, object_pairs_hook=without_doubles)
    except (ValueError, RecursionError) as error:
        raise BadConfig(f"{where} is not JSON: {web_page(data) or error}") from error
    if not isinstance(content, dict):
        raise BadConfig(f"{where} must hold a JSON object, found {type(content).__name__}")
    return content


def without_doubles(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of JSON, for parsers. Raises ValueError for a key that stands twice."""
    tree = dict(pairs)  # of two values of a key the last
    if len(tree) < len(pairs):
        twice, _ = Counter(key for key, _ in pairs).most_common(1)[0]
        raise ValueError(f"the key {twice!r} stands twice")
    return tree


def web_page(data: bytes) -> str:
    """Say that data begin as a web page, which a server or a portal may have sent in place of a file; else ""."""
    if data[:200].lstrip().lower().startswith((b"<!doctype html", b"<html", b"<?xml")):
        return "found a web page (HTML): is the address right, and may it be read without signing in?"
    return ""


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write JSON at once or not at all. Raises BadConfig."""
    write_result(path, (json.dumps(content, indent=1) + "\n").encode())


def read_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file. Raises BadConfig, naming it."""
    return parse_json(read_bytes(path, _LARGEST_JSON), str(path))


def read_bytes(path: Path, limit: int = _LARGEST_FILE) -> bytes:
    """All of a file. Raises BadConfig, naming it, if it is missing, no plain file or larger than `limit` bytes."""
    with reported(f"cannot read {path}", BadConfig, OSError):
        refuse_special(path)
        if path.stat().st_size > limit:
            raise BadConfig(f"{path} is larger than {limit} bytes")
        return path.read_bytes()


def contents(path: Path, packed: bool, limit: int) -> bytes | None:
    """Read a file, decompressed if it is `packed` with gzip; None if it holds more than `limit` bytes.

    Raises OSError if it cannot be read, gzip.BadGzipFile, EOFError or zlib.error if it is no complete gzip file.
    """
    refuse_special(path)
    data = bytearray()
    with gzip.open(path) if packed else path.open("rb") as file:
        while len(data) <= limit and (chunk := file.read(_CHUNK_BYTES)):
            data += chunk
    return bytes(data) if len(data) <= limit else None


def _is_number(value: Any) -> bool:
    """True for a finite number that fits a float: TOML allows whole numbers of any length."""
    return not isinstance(value, bool) and isinstance(value, int | float) and abs(value) < 1e300


class Table:
    """A table of TOML or JSON, read key by key; a key that is never read is an error, so a misspelt one stops the run.

    Every method that reads a key removes it, and raises BadConfig, naming `where`, if it is missing or of another kind.
    """

    def __init__(self, tree: Any, where: str) -> None:
        if not isinstance(tree, dict):
            raise BadConfig(f"{where} must be an object, found {type(tree).__name__}")
        self._tree, self.where = dict(tree), where

    def _take(self, key: str, kind: str) -> Any:
        try:
            return self._tree.pop(key)
        except KeyError:
            raise BadConfig(f"{self.where}: {kind} {key!r} is missing") from None

    def number(self, key: str) -> float:
        """Read a finite number."""
        value = self._take(key, "number")
        if not _is_number(value):
            raise BadConfig(f"{self.where}: {key!r} must be a finite number, found {str(value)[:60]!r}")
        return float(value)

    def positive(self, key: str) -> float:
        """Read a finite number above 0."""
        value = self.number(key)
        if value <= 0:
            raise BadConfig(f"{self.where}: {key!r} must be positive, found {value:g}")
        return value

    def whole(self, key: str) -> int:
        """Read a whole number."""
        value = self.number(key)
        if value != int(value):
            raise BadConfig(f"{self.where}: {key!r} must be a whole number, found {value!r}")
        return int(value)

    def _of(self, kind: type[Value], key: str, what: str, words: str) -> Value:
        value = self._take(key, what)
        if not isinstance(value, kind):
            raise BadConfig(f"{self.where}: {key!r} must be {words}, found {str(value)[:60]}")
        return value

    def flag(self, key: str) -> bool:
        """Read true or false."""
        return self._of(bool, key, "flag", "true or false")

    def text(self, key: str) -> str:
        """Read a text."""
        return self._of(str, key, "text", "text")

    def numbers(self, key: str, count: int) -> Any:
        """Read a list of `count` finite numbers, as a tuple of floats."""
        values = self._take(key, "list")
        if not isinstance(values, list | tuple) or len(values) != count or not all(map(_is_number, values)):
            raise BadConfig(f"{self.where}: {key!r} must be {count} finite numbers, found {str(values)[:60]}")
        return tuple(float(value) for value in values)

    def table(self, key: str) -> Table:
        """Read a table within this one."""
        return Table(self._of(dict, key, "table", "a table"), f"{self.where}, [{key}]")

    def __iter__(self) -> Iterator[str]:
        """Give the keys that are not read yet."""
        return iter(self._tree)

    def finish(self) -> None:
        """Raise BadConfig for keys that were not read."""
        if self._tree:
            raise BadConfig(f"{self.where}: unknown {', '.join(map(repr, sorted(self._tree)))}")


@dataclass(frozen=True)
class TomlFiles:
    """TOML files of one kind: those of a folder, by name, and any other, by its path.

    kind: what one holds, for messages. file_format: the `format` that each states. further: names known to the caller
    without a file, which messages list first.
    """

    kind: str
    folder: Traversable
    file_format: str
    further: tuple[str, ...] = ()

    def names(self) -> tuple[str, ...]:
        """Further names, then those of the folder's files, without their suffix, in alphabetical order."""
        files = (file.name for file in self.folder.iterdir())
        return (*self.further, *sorted(name.removesuffix(".toml") for name in files if name.endswith(".toml")))

    def read(self, name_or_path: str | Path) -> str:
        """Read a file of the folder by name, or any by its .toml path. Raises BadConfig if absent or unreadable."""
        if not isinstance(name_or_path, str | Path):
            raise BadConfig(f"a {self.kind} is given by its name or a path, found {name_or_path!r:.100}")
        path = Path(name_or_path)
        if path.suffix != ".toml":
            names = self.names()
            if str(name_or_path) not in names[len(self.further) :]:
                raise BadConfig(
                    f"no {self.kind} is called {str(name_or_path)!r}: give one of {', '.join(names)} or the path of a "
                    ".toml file"
                )
            return (self.folder / f"{name_or_path}.toml").read_text(encoding="utf-8")
        with reported(f"cannot read the {self.kind} file {path}", BadConfig, OSError, UnicodeDecodeError):
            refuse_special(path)
            with path.open(encoding="utf-8") as file:
                return file.read(_LARGEST_TOML + 1)

    def parse(self, text: str, where: str) -> dict[str, Any]:
        """Parse the text of a file; the tree comes without its format. where: its origin. Raises BadConfig."""
        with reported(f"{self.kind} {where} is not TOML", BadConfig, ValueError, RecursionError):
            if len(text) > _LARGEST_TOML:
                raise ValueError(f"it must have at most {_LARGEST_TOML} letters")
            if found := _DOTTED.search(text):
                raise ValueError(f"a key must have at most 17 parts, found {found[0][:30]}...")
            tree = tomllib.loads(text)
            repr(tree)  # raises ValueError for a hexadecimal number that is longer than Python prints
        if tree.pop("format", None) != self.file_format:
            raise BadConfig(f"{self.kind} {where}: 'format' must be {self.file_format!r}")
        return tree
