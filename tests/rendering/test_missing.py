"""Without a system library or a package, the one line that a user sees says what to install.

The absence is staged in a process that has no library of renderers yet, since libraries that are loaded stay loaded.
"""

from __future__ import annotations

import importlib.util
import os
import sys

import pytest
import warm
from folders import HELPERS, ROOT

from bodyseg_data.core import MissingLibrary
from bodyseg_data.machine import libraries, missing_library, require_libraries

OPEN_GL = "from bodyseg_data.rendering import open_renderer\nopen_renderer('opengl', ball())"
OPEN_RASTER = "from bodyseg_data.rendering import open_renderer\nopen_renderer('raster', ball())"
OPEN_EMBREE = "from bodyseg_data.rendering import open_renderer\nopen_renderer('embree', ball())"
REPAIR = "from bodyseg_data.meshes.repairing import repair\nrepair('ball', ball().vertices, ball().faces)"

STAGE = """
import ctypes, ctypes.util, sys
sys.path[:0] = {paths!r}
hidden, packages = {hidden!r}, {packages!r}
find, load = ctypes.util.find_library, ctypes.CDLL.__init__

def found(name):
    return None if name in hidden else find(name)

def loaded(self, name, *rest, **options):
    if any(f"lib{{library}}.so" in str(name) or library == name for library in hidden):
        raise OSError(f"{{name}}: cannot open shared object file: No such file or directory")
    load(self, name, *rest, **options)

ctypes.util.find_library, ctypes.CDLL.__init__ = found, loaded
sys.modules.update(dict.fromkeys(packages))

from shapes import ball
from bodyseg_data.core.errors import MissingLibrary
try:
    {action}
except MissingLibrary as error:
    sys.stdout.write("MISSING " + str(error))
else:
    sys.stdout.write("FINE")
"""

needs_pyrender = pytest.mark.skipif(importlib.util.find_spec("pyrender") is None, reason="pyrender is not installed")
needs_linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="library names of Linux")


def outcome(action: str, hidden: tuple[str, ...] = (), packages: tuple[str, ...] = (), **settings: str) -> str:
    """What became of `action` in a process without the libraries `hidden` and without `packages`."""
    script = STAGE.format(
        paths=[str(HELPERS), str(ROOT)],
        hidden=hidden,
        packages=packages,
        action=action.replace("\n", "\n    "),
    )
    names = ("PYOPENGL_PLATFORM", "DISPLAY", "EGL_DEVICE_ID")
    environment = {key: value for key, value in os.environ.items() if key not in names} | settings
    answer = warm.run(["-c", script], env=environment)
    assert answer.returncode == 0, answer.stderr
    assert "\n" not in answer.stdout, "the message is one line"
    return answer.stdout


@needs_pyrender
@needs_linux
@pytest.mark.parametrize(
    ("hidden", "settings", "packages"),
    [
        (("EGL",), {}, ("libegl1",)),
        (("GL", "GLESv2", "GLESv1_CM"), {}, ("libgl1",)),
        (("EGL", "GL"), {}, ("libegl1", "libgl1")),
        (("OSMesa",), {"PYOPENGL_PLATFORM": "osmesa"}, ("libosmesa6",)),
        (("X11",), {"DISPLAY": ":9999"}, ("libx11-6",)),
    ],
    ids=["EGL", "GL", "both", "OSMesa", "X11"],
)
def test_an_absent_library_is_named_with_its_package(hidden, settings: dict[str, str], packages: tuple[str]) -> None:
    answer = outcome(OPEN_GL, hidden=hidden, **settings)
    told = answer.partition(" (")[0]  # what follows is the cause in PyOpenGL's words; other libraries may be absent too
    assert told.startswith("MISSING the opengl renderer needs lib"), answer
    assert f"lib{hidden[0]}" in told
    assert set(packages) <= set(told.partition(": apt-get install ")[2].split())
    assert answer.endswith("; the embree renderer needs nothing from the system")


def test_embree_needs_none_of_them() -> None:
    hidden = ("EGL", "GL", "GLX", "OpenGL", "GLESv2", "OSMesa", "X11", "xcb")
    assert outcome(OPEN_EMBREE, hidden=hidden, packages=("pyrender", "OpenGL", "pyglet", "pymeshlab")) == "FINE"


@needs_pyrender
@needs_linux
def test_no_device_asks_for_a_software_driver() -> None:
    answer = outcome(OPEN_GL, EGL_DEVICE_ID="99")
    if "needs lib" in answer:
        pytest.skip(answer)
    assert "nothing can be opened on PYOPENGL_PLATFORM='egl'" in answer and "apt-get install libgl1-mesa-dri" in answer


@needs_pyrender
@needs_linux
def test_an_unreachable_display_points_to_egl() -> None:
    answer = outcome(OPEN_GL, DISPLAY=":9999")
    if "needs lib" in answer:
        pytest.skip(answer)
    assert "nothing can be opened on PYOPENGL_PLATFORM" in answer and "egl needs no display" in answer


@pytest.mark.parametrize(
    ("action", "package"),
    [(OPEN_GL, "pyrender"), (OPEN_EMBREE, "embreex"), (OPEN_RASTER, "numba"), (REPAIR, "pymeshlab")],
)
def test_an_absent_package_is_named(action: str, package: str) -> None:
    answer = outcome(action, packages=(package, f"{package}.mesh_construction"))
    extra = {"numba": "fast", "pymeshlab": "pymeshlab"}.get(package, "render")
    assert answer.startswith("MISSING ") and f"'{package}" in answer and f"pip install 'bodyseg[{extra}]'" in answer


@needs_linux
def test_mesh_repair_does_not_start_half_working() -> None:
    assert outcome(REPAIR, hidden=("OpenGL",)) == "MISSING mesh repair needs libOpenGL: apt-get install libopengl0"


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (ImportError("libGLX.so.0: cannot open shared object file"), "x needs libGLX: apt-get install libglx0 ("),
        (ImportError('Library "X11" not found.'), "x needs libX11: apt-get install libx11-6 ("),
        (OSError("OSMesa: cannot open shared object file"), "x needs libOSMesa: apt-get install libosmesa6 ("),
        (OSError("libodd.so.3: gone"), "x needs libodd: install it with the system's package manager ("),
        (AttributeError("no glGetError\n here"), "x cannot be loaded: no glGetError here"),
        (ImportError(), "x cannot be loaded: ImportError"),
    ],
)
def test_messages(error: Exception, told: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(libraries, "can_load", lambda name: False)
    assert str(missing_library("x", error)).startswith(told)


def test_a_library_named_by_the_cause_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(libraries, "can_load", lambda name: name != "EGL")
    error = ImportError("no luck")
    error.__cause__ = OSError("libEGL.so.1: cannot open; libGL.so.1 is fine")
    assert str(missing_library("x", error)) == "x needs libEGL: apt-get install libegl1 (no luck)"


def test_elsewhere_than_on_linux_no_package_of_debian_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.platform", "darwin")
    require_libraries("x", ("nothinglikethis",))
    told = str(missing_library("x", ImportError("no OpenGL framework here"), ("nothinglikethis", "EGL")))
    assert told == "x cannot be loaded: no OpenGL framework here"


@needs_linux
def test_required_libraries() -> None:
    require_libraries("x", ("c",))
    with pytest.raises(MissingLibrary, match="x needs libnothinglikethis: install it"):
        require_libraries("x", ("c", "nothinglikethis"))
