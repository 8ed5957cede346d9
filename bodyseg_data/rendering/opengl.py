"""Rasterisation with OpenGL through pyrender: the fast renderer on a graphics card (docs/explanation/renderers.md).

Needs the system libraries libEGL and libGL; without them, importing this module raises MissingLibrary. pyrender selects
the platform by PYOPENGL_PLATFORM; on Linux with neither that nor DISPLAY set, it is EGL.
"""

import os
import sys
import warnings
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bodyseg_data.core import BadConfig, BadMesh, MissingLibrary
from bodyseg_data.machine import SOFTWARE_DRIVER, missing_library
from bodyseg_data.meshes import Mesh
from bodyseg_data.rendering.renderer import Renderer, Surface
from bodyseg_data.rigs import Camera, PlacedCamera

_FEATURE: Final = "the opengl renderer"
_ALTERNATIVE: Final = "the embree renderer needs nothing from the system"
if sys.platform.startswith("linux") and "DISPLAY" not in os.environ:
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")  # pyrender and PyOpenGL read it when they are imported
_PLATFORM: Final = os.environ.get("PYOPENGL_PLATFORM", "")
_SYSTEM_LIBRARIES: Final = {"egl": ("EGL", "GL"), "osmesa": ("OSMesa",)}.get(_PLATFORM, ("GL", "X11"))

try:
    with warnings.catch_warnings():
        # pyrender and PyOpenGL are no longer maintained and use features that Python deprecates.
        warnings.simplefilter("ignore")
        import pyrender
        from OpenGL import GL
except (ImportError, OSError, AttributeError) as error:
    raise MissingLibrary(f"{missing_library(_FEATURE, error, _SYSTEM_LIBRARIES)}; {_ALTERNATIVE}") from error

_NEAR_PLANE_M = 1e-2
_MARGIN_M = 1e-3
MOST_FACES = 2**24  # a face's index is drawn as a colour of three bytes


class OpenGLRenderer(Renderer):
    """Renderer of one mesh, which stays in the graphics driver's memory, for any number of cameras.

    All renderers of a process share one OpenGL context and its thread, so threads may use them at the same time.
    Surfaces less than 10 mm in front of the camera's plane are clipped; Embree renders all in front of that plane.

    Raises BadMesh for a mesh of more than 16.7 million faces, MissingLibrary if no driver can be opened; BadConfig when
    it draws in a process forked from one that has an OpenGL context.
    """

    def __init__(self, mesh: Mesh) -> None:
        if len(mesh.faces) > MOST_FACES:
            raise BadMesh(f"mesh {mesh.name}: OpenGL draws at most {MOST_FACES} faces, found {len(mesh.faces)}")
        # Graphics hardware computes in single precision, so coordinates are kept small: relative to the body's centre.
        self._origin = mesh.centre
        self._surface_vertices = mesh.surface_vertices
        corners = (mesh.vertices - self._origin)[mesh.faces].reshape(-1, 3)
        self._mesh = pyrender.Mesh([pyrender.Primitive(positions=corners, color_0=_face_colours(len(mesh.faces)))])
        self._scene = pyrender.Scene(bg_color=(0.0, 0.0, 0.0, 0.0))
        self._scene.add(self._mesh)
        self._camera_node = self._scene.add(_Projection(np.eye(4)))
        self._context = _shared_context()

    def render(self, camera: PlacedCamera) -> Surface:
        """See `Renderer.render`; the range is the depth at the exact centre of each pixel."""
        rows, columns = camera.camera.rows, camera.camera.columns
        surface = Surface(np.zeros((rows, columns), np.float32), np.full((rows, columns), -1, np.int32))
        local_z = camera.to_local(self._surface_vertices)[:, 2]
        # The depth buffer's 24 bits cover the depth of the body only.
        near = max(float(local_z.min()) - _MARGIN_M, _NEAR_PLANE_M)
        far = float(local_z.max()) + _MARGIN_M
        if far <= near:
            return surface  # all of it is behind the camera
        pose = np.eye(4)
        pose[:3, :3] = (camera.axes * [[1], [-1], [-1]]).T  # OpenGL's cameras have y up and look along -z
        pose[:3, 3] = camera.position - self._origin
        self._scene.set_pose(self._camera_node, pose)
        self._camera_node.camera = _Projection(_projection(camera.camera, near, far))
        depth, colour = self._context.draw(self._scene, rows, columns)
        body = colour[..., 3] > 0
        surface.face[body] = colour[body][:, :3].astype(np.int32) @ np.array([1, 1 << 8, 1 << 16], np.int32)
        # Window depth 0 to 1 is linear in 1 / z between the two planes.
        surface.range[body] = 1 / (1 / near + depth[body].astype(np.float64) * (1 / far - 1 / near))
        return surface

    def close(self) -> None:
        """Free the mesh's memory in the driver; the context stays open for other meshes. Safe to call twice."""
        self._context.remove_mesh(self._mesh)


class _Projection(pyrender.Camera):  # type: ignore[misc]
    """A camera defined by its projection matrix; pyrender's own depends on the platform's pixel density."""

    def __init__(self, matrix: NDArray[np.float64]) -> None:
        super().__init__()
        self._matrix = matrix

    def get_projection_matrix(self, width: int | None = None, height: int | None = None) -> NDArray[np.float64]:
        return self._matrix


class _SingleSampleRenderer(pyrender.Renderer):  # type: ignore[misc]
    """pyrender's renderer with one sample a pixel, exact colours, and meshes that stay in memory until removed.

    pyrender draws four samples a pixel and returns the depth of the first, which lies off the pixel's centre.
    The overridden methods are private, but pyrender 0.1.45 is its last release.
    """

    _main_fb_ms: int | None
    _main_fb_dims: tuple[int, int]

    def __init__(self) -> None:
        super().__init__(1, 1)
        self.dpscale = 1  # an image has the requested size, also on displays of high pixel density

    def _update_context(self, scene: Any, flags: int) -> None:
        for mesh in scene.meshes - self._meshes:
            for primitive in mesh.primitives:
                primitive._add_to_context()
            self._meshes.add(mesh)

    def remove_mesh(self, mesh: Any) -> None:
        if mesh in self._meshes:
            self._meshes.remove(mesh)
            for primitive in mesh.primitives:
                primitive.delete()

    def _configure_main_framebuffer(self) -> None:
        """Keep one framebuffer without multisampling, as large as the largest image so far: new ones are slow."""
        width, height = self._main_fb_dims if self._main_fb_ms else (0, 0)
        if self.viewport_width <= width and self.viewport_height <= height:
            return
        size = max(self.viewport_width, width), max(self.viewport_height, height)
        self._delete_main_framebuffer()
        self._main_cb_ms, self._main_db_ms = GL.glGenRenderbuffers(2)
        self._main_fb_ms = GL.glGenFramebuffers(1)
        GL.glBindFramebuffer(GL.GL_DRAW_FRAMEBUFFER, self._main_fb_ms)
        for buffer, kind, attachment in (
            (self._main_cb_ms, GL.GL_RGBA8, GL.GL_COLOR_ATTACHMENT0),
            (self._main_db_ms, GL.GL_DEPTH_COMPONENT24, GL.GL_DEPTH_ATTACHMENT),
        ):
            GL.glBindRenderbuffer(GL.GL_RENDERBUFFER, buffer)
            GL.glRenderbufferStorage(GL.GL_RENDERBUFFER, kind, *size)
            GL.glFramebufferRenderbuffer(GL.GL_DRAW_FRAMEBUFFER, attachment, GL.GL_RENDERBUFFER, buffer)
        self._main_fb_dims = size
        # Colours encode face indices and must be read back exactly.
        GL.glDisable(GL.GL_DITHER)
        GL.glDisable(GL.GL_FRAMEBUFFER_SRGB)

    def _delete_main_framebuffer(self) -> None:
        if self._main_fb_ms is not None:
            GL.glDeleteFramebuffers(1, [self._main_fb_ms])
            GL.glDeleteRenderbuffers(2, [self._main_cb_ms, self._main_db_ms])
            self._main_fb_ms = None

    def _read_main_framebuffer(self, scene: Any, flags: int) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """Window depth, float32 [H, W], 0 to 1, and colour, uint8 [H, W, 4]; the first row is the top."""
        width, height = self.viewport_width, self.viewport_height
        GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, self._main_fb_ms)
        depth = GL.glReadPixels(0, 0, width, height, GL.GL_DEPTH_COMPONENT, GL.GL_FLOAT)
        colour = GL.glReadPixels(0, 0, width, height, GL.GL_RGBA, GL.GL_UNSIGNED_BYTE)
        return (
            np.frombuffer(depth, np.float32).reshape(height, width)[::-1],
            np.frombuffer(colour, np.uint8).reshape(height, width, 4)[::-1],
        )


class _Context:
    """The process's OpenGL context, which one thread draws in for all.

    It stays current there: pyrender's renderers close EGL's display for all as they go, those of the user's program
    too, and by EGL's rules only contexts that are current somewhere outlive that.
    """

    def __init__(self) -> None:
        self._process = os.getpid()
        self._thread = ThreadPoolExecutor(1, "opengl")
        try:
            self._window = self._thread.submit(pyrender.OffscreenRenderer, 1, 1).result()
        except Exception as error:  # platforms differ: EGL errors, assertions, X errors, lookups
            cause = " ".join(str(error).split()) or type(error).__name__
            where = f"nothing can be opened on PYOPENGL_PLATFORM={_PLATFORM!r} ({cause})"
            hint = f"egl needs no display, and drivers in software are in {SOFTWARE_DRIVER}"
            install = f"apt-get install {SOFTWARE_DRIVER}"
            raise MissingLibrary(f"{_FEATURE}: {where}; {hint}: {install}; {_ALTERNATIVE}") from error
        self._window._renderer = self._renderer = self._thread.submit(_SingleSampleRenderer).result()

    def draw(self, scene: Any, rows: int, columns: int) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        if self._process != os.getpid():  # drivers would hang
            raise BadConfig(f"{_FEATURE} cannot draw in a fork of a process that has drawn: start workers by 'spawn'")
        return self._thread.submit(self._draw, scene, rows, columns).result()

    def _draw(self, scene: Any, rows: int, columns: int) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        flags = pyrender.RenderFlags
        self._renderer.viewport_width, self._renderer.viewport_height = columns, rows
        # Embree hits both sides of a triangle, so both are drawn here.
        picture: tuple[NDArray[np.float32], NDArray[np.uint8]] = self._renderer.render(
            scene, flags.OFFSCREEN | flags.FLAT | flags.SKIP_CULL_FACES
        )
        return picture

    def remove_mesh(self, mesh: Any) -> None:
        if self._process == os.getpid():  # in a fork, context and mesh belong to the parent
            with suppress(RuntimeError):  # as Python ends, threads take no more work, and the mesh goes with all others
                self._thread.submit(self._renderer.remove_mesh, mesh).result()


@cache
def _shared_context() -> _Context:
    """The one context of the process, as opening one is slow; threads that ask for the first at once get one each."""
    return _Context()


def _face_colours(count: int) -> NDArray[np.float32]:
    """Colours that encode face indices in bytes, float32 [3 * count, 4], 0 to 1, one a corner; alpha is 1."""
    index = np.arange(count)
    parts = np.stack([index & 255, index >> 8 & 255, index >> 16 & 255, np.full(count, 255)], axis=1)
    return np.repeat(parts.astype(np.float32) / np.float32(255), 3, axis=0)


def _projection(camera: Camera, near: float, far: float) -> NDArray[np.float64]:
    """OpenGL's projection matrix [4, 4] of a pinhole camera. near, far: its clipping planes, metres."""
    x, y = camera.centre_px
    matrix = np.zeros((4, 4))
    matrix[0, [0, 2]] = 2 * camera.focal_px / camera.columns, 1 - 2 * x / camera.columns
    matrix[1, [1, 2]] = 2 * camera.focal_px / camera.rows, 2 * y / camera.rows - 1
    matrix[2, [2, 3]] = (near + far) / (near - far), 2 * near * far / (near - far)
    matrix[3, 2] = -1
    return matrix
