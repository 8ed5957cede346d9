"""Which package gives a library that is missing: the one place that turns a failed import into one clear line.

Some optional packages (pyrender, pymeshlab) load libraries that pip does not bring along. What they raise when one is
absent differs from package to package and rarely names what to install.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import re
import sys
from collections.abc import Iterable
from typing import Final

from bodyseg_data.core.errors import MissingLibrary

DEBIAN_PACKAGES: Final = {
    "EGL": "libegl1",
    "GL": "libgl1",
    "GLU": "libglu1-mesa",
    "GLX": "libglx0",
    "GLdispatch": "libglvnd0",
    "OSMesa": "libosmesa6",
    "OpenGL": "libopengl0",
    "X11": "libx11-6",
    "gomp": "libgomp1",
    "stdc++": "libstdc++6",
    "xcb": "libxcb1",
    "z": "zlib1g",
}
"""Name of a shared library, without "lib" and ".so", -> the package of Debian and Ubuntu that holds it."""

SOFTWARE_DRIVER: Final = "libgl1-mesa-dri"
"""The package with a driver that draws without a graphics card."""

_IN_MESSAGE: Final = re.compile(
    r'lib([\w+-]+?)\.so|Library "([\w+-]+)" not found|(?<![\w.+-])([A-Za-z]\w*): cannot open'
)


def missing_library(feature: str, error: BaseException, needs: Iterable[str] = ()) -> MissingLibrary:
    """The error to raise when `feature` could not be imported because of `error`.

    error: what the import raised: ImportError, OSError or AttributeError. needs: names of shared libraries that the
    feature loads. They are tried, because the error itself may not say which one is absent: PyOpenGL answers a missing
    libGL with an AttributeError of None.
    """
    cause = " ".join(str(error).split()) or type(error).__name__
    if isinstance(error, ModuleNotFoundError):
        return MissingLibrary(f"{feature} needs the package {error.name!r}: pip install 'bodyseg[render]' ({cause})")
    names = dict.fromkeys([*needs, *_named_in(error)])
    absent = [name for name in names if not _loads(name)]
    if absent:
        return MissingLibrary(f"{_needs(feature, absent)} ({cause})")
    return MissingLibrary(f"{feature} cannot be loaded: {cause}")


def require_libraries(feature: str, needs: Iterable[str]) -> None:
    """Raise MissingLibrary if one of the shared libraries `needs` is absent, on Linux; elsewhere names differ.

    For packages that come up half-working without a library instead of refusing to be imported.
    """
    absent = [name for name in needs if not _loads(name)] if sys.platform.startswith("linux") else []
    if absent:
        raise MissingLibrary(_needs(feature, absent))


def _loads(name: str) -> bool:
    try:
        ctypes.CDLL(ctypes.util.find_library(name) or f"lib{name}.so")
    except OSError:
        return False
    return True


def _named_in(error: BaseException) -> list[str]:
    """Names of libraries in the messages of an error and of those that led to it."""
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
