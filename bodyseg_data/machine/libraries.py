"""Optional packages and shared libraries: errors that name what to install, and the quickest library for deflate.

Some optional packages (pyrender, pymeshlab) load shared libraries that pip does not install. The errors they raise
without them differ from package to package and rarely name the system's package. Streams of deflate, as PNG files hold
them, are made by isal where it is installed (`bodyseg[fast]`), else by zlib.
"""

import contextlib
import ctypes
import ctypes.util
import re
import sys
import threading
import warnings
import zlib
from collections.abc import Iterable, Iterator
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, Final

from bodyseg_data.core import MissingLibrary

DEBIAN_PACKAGES: Final = {
    "EGL": "libegl1", "GL": "libgl1", "GLU": "libglu1-mesa", "GLX": "libglx0", "GLdispatch": "libglvnd0",
    "OSMesa": "libosmesa6", "OpenGL": "libopengl0", "X11": "libx11-6", "gomp": "libgomp1", "stdc++": "libstdc++6",
    "xcb": "libxcb1", "z": "zlib1g",
}  # fmt: skip
"""Name of a shared library, without "lib" and ".so", -> its package in Debian and Ubuntu."""

SOFTWARE_DRIVER: Final = "libgl1-mesa-dri"
"""Package of a driver that renders without a graphics card."""

_ONE_THREAD: Final = threading.Lock()

_IN_MESSAGE: Final = re.compile(
    r'lib([\w+-]+?)\.so|Library "([\w+-]+)" not found|(?<![\w.+-])([A-Za-z]\w*): cannot open'
)


def required(name: str, feature: str, extra: str = "render") -> Any:
    """Import an optional package's module. Raises MissingLibrary: `feature` needs it, and `extra` installs it."""
    try:
        return import_module(name)
    except ImportError as error:
        raise missing_library(feature, error, extra=extra) from error


def missing_library(
    feature: str, error: BaseException, needs: Iterable[str] = (), extra: str = "render"
) -> MissingLibrary:
    """Return the error to raise when `feature` cannot be imported because of `error`.

    error: ImportError, OSError or AttributeError of the import. needs: names of shared libraries that the feature
    loads. Each is loaded as a test, because the error may not name the missing one: without libGL, PyOpenGL raises an
    AttributeError of None. extra: of this project, which installs the package.
    """
    cause = " ".join(str(error).split()) or type(error).__name__
    if isinstance(error, ModuleNotFoundError):
        package = (error.name or "").partition(".")[0]
        return MissingLibrary(f"{feature} needs the package {package!r}: pip install 'bodyseg[{extra}]' ({cause})")
    absent = [name for name in dict.fromkeys([*needs, *_named_in(error)]) if not can_load(name)]
    if absent:
        return MissingLibrary(f"{_needs(feature, absent)} ({cause})")
    return MissingLibrary(f"{feature} cannot be loaded: {cause}")


def require_libraries(feature: str, needs: Iterable[str]) -> None:
    """Raise MissingLibrary if a shared library of `needs` is absent: for packages that can be imported without it."""
    absent = [name for name in needs if not can_load(name)]
    if absent:
        raise MissingLibrary(_needs(feature, absent))


def can_load(name: str) -> bool:
    """Load a shared library as a test; `name` as in "GL" for libGL. True but on Linux, whose names they are."""
    try:
        ctypes.CDLL(ctypes.util.find_library(name) or f"lib{name}.so")
    except OSError:
        return not sys.platform.startswith("linux")
    return True


@contextlib.contextmanager
def opened_picture(file: Any, formats: tuple[str, ...], strict: bool = False) -> Iterator[Any]:
    """Open a picture by Pillow, of which nothing is shown on standard error. strict: what it warns of is a ValueError.

    Filters of warnings are the process's: one thread at a time changes them, and what others warn of is passed on.
    """
    from PIL import Image

    _prepare_tiff()
    with _ONE_THREAD, warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        picture: Any = Image.open(file, formats=formats)
    with picture:
        for each in said:
            if "PIL" not in Path(each.filename).parts:
                warnings.warn_explicit(each.message, each.category, each.filename, each.lineno)
            elif strict:
                raise ValueError(str(each.message))
        for tile in [each for each in picture.tile if each[0] == "libtiff"]:  # in the machine's byte order
            native = re.sub("(;16(?=BS)|;32|;64)B", r"\1N", tile[3][0])  # as Pillow does for unsigned 16 bits
            picture.tile = [getattr(tile, "_make", tuple)((*tile[:3], (native, *tile[3][1:])))]
        yield picture


@cache
def _prepare_tiff() -> None:
    """Have Pillow read 64-bit floats, which it decodes but does not list, and keep its libtiff off standard error."""
    from PIL import TiffImagePlugin, _imaging

    for order, raw in ((b"II", "F;64F"), (b"MM", "F;64BF")):
        for grey in (0, 1):  # 0 is white, or black
            TiffImagePlugin.OPEN_INFO.setdefault((order, grey, (3,), 1, (64,), ()), ("F", raw))
    with contextlib.suppress(OSError, AttributeError):  # a Pillow without libtiff
        library = ctypes.CDLL(_imaging.__file__)  # whose dependencies are searched, too
        for name in ("TIFFSetErrorHandler", "TIFFSetWarningHandler"):
            getattr(library, name)(None)


def _named_in(error: BaseException) -> list[str]:
    """List the libraries named in the messages of an error and of its causes."""
    names: dict[str, None] = {}
    link: BaseException | None = error
    while link is not None:
        for match in _IN_MESSAGE.finditer(str(link)):
            names[next(group for group in match.groups() if group)] = None
        link = link.__cause__ or link.__context__
    return list(names)


def _needs(feature: str, absent: list[str]) -> str:
    libraries = " and ".join(f"lib{name}" for name in absent)
    packages = [DEBIAN_PACKAGES[name] for name in absent if name in DEBIAN_PACKAGES]
    remedy = f"apt-get install {' '.join(packages)}" if packages else "install it with the system's package manager"
    return f"{feature} needs {libraries}: {remedy}"


def compress(data: Any, level: int) -> bytes:
    """Compress bytes into zlib's format. level: 0 to 3.

    isal and zlib write other streams of the same content, and isal may write another one when it is called again: so
    what must have the same bytes every time, like shards, is compressed elsewhere.
    """
    packed: bytes = deflate_library().compress(data, level)
    return packed


@cache
def deflate_library() -> Any:
    """The module that compresses: isal's, whose functions and errors are those of zlib, or zlib."""
    try:
        return import_module("isal.isal_zlib")
    except ImportError:
        return zlib
