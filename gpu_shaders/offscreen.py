# SPDX-License-Identifier: GPL-3.0-or-later
"""The active camera's view of baked objects, through the viewport's shaders, without a viewport.

Works in Blender with its interface, in `blender --background` and in the bpy wheel (the latter two need a driver: on
Linux libEGL and Mesa suffice). Main thread only. Pictures are scene-linear arrays whose row 0 is the top; the view
transform is applied by `write_png`, through Blender's own saving of renders.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import bpy
import gpu
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..prt_addon.errors import BadArguments, BadScene, PRTError
from ..prt_addon.lighting.environment import pixel_of_direction
from ..prt_addon.storage.files import write_atomically
from . import programs
from .draw import DrawingCache, read_texture
from .render_data import LARGEST_TEXTURE, DrawItem

if TYPE_CHECKING:
    from ..prt_addon.storage.container import BakedTransfer

SUBPIXELS = 256  # places per pixel of an environment, as in a GPU's own bilinear filter


@functools.cache
def prepare_gpu() -> None:
    """Make the GPU module usable in background mode and the bpy wheel. Raises PRTError where no driver is found.

    `gpu.init()` takes the whole process down where there is no driver, so a child process tries it first (1 to 2 s,
    once per process).
    """
    if not bpy.app.background:
        return
    attempt = subprocess.run(_probe_command(), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=False)
    if attempt.returncode != 0:
        raise PRTError(
            "the preview",
            "Blender found no working graphics driver",
            "Install OpenGL or Vulkan drivers (on Linux Mesa with libEGL), or use `relight`, which needs none",
        )
    gpu.init()
    atexit.register(programs.release)  # a script's sys.exit ends Python after Blender's GPU module, which crashes


def _probe_command() -> list[str]:
    """A command that ends in 0 exactly where `gpu.init()` works, for this Python or this Blender and its backend."""
    if bpy.app.module:
        return [sys.executable, "-c", "import bpy, gpu; gpu.init()"]
    backend = "--gpu-backend"
    chosen = sys.argv[sys.argv.index(backend) :][:2] if backend in sys.argv else []
    expression = "import gpu; gpu.init()"
    return [bpy.app.binary_path, "--background", "--factory-startup", *chosen, "--python-expr", expression]


def draw_camera(
    scene: bpy.types.Scene,
    baked: Sequence[tuple[BakedTransfer, ArrayLike]],
    light: ArrayLike,
    width: int,
    height: int,
    background: ArrayLike | None = None,
    samples: int = 2,
) -> NDArray[np.float32]:
    """The active camera's picture of baked objects under one light: (height, width, 4) float32 scene-linear.

    baked: pairs of a bake and the (4, 4) transform from world space at bake time to now (identity where nothing moved);
    light: (columns, 3) coefficients; background and samples: see `draw_items`, which also says what is raised.
    """
    items = [DrawItem(index, transfer, matrix, light) for index, (transfer, matrix) in enumerate(baked)]
    return draw_items(scene, items, width, height, background, samples)


def draw_items(
    scene: bpy.types.Scene,
    items: Sequence[DrawItem],
    width: int,
    height: int,
    background: ArrayLike | None = None,
    samples: int = 2,
) -> NDArray[np.float32]:
    """The active camera's picture of draw items: (height, width, 4) float32 scene-linear, premultiplied, row 0 up.

    background: None (transparent), a colour (3,) or a picture (height, width, 3), e.g. of `camera_background`.
    samples: per pixel and axis, averaged in scene-linear; reduced where the enlarged picture would not fit a texture.
    Raises BadArguments for a size that does not fit, BadScene for a camera or a light that does not, PRTError without
    a graphics driver.
    """
    return draw_view(items, camera_view_projection(scene, width, height), width, height, background, samples)


def draw_view(
    items: Sequence[DrawItem],
    view_projection: NDArray[np.float64],
    width: int,
    height: int,
    background: ArrayLike | None = None,
    samples: int = 2,
) -> NDArray[np.float32]:
    """As `draw_items`, seen through any (4, 4) from world to clip space."""
    prepare_gpu()
    samples = max(1, min(samples, LARGEST_TEXTURE // max(width, height)))
    cache = DrawingCache()
    try:
        with _offscreen(width * samples, height * samples) as target:
            cache.draw(items, view_projection)
            drawn = read_texture(target.texture_color)
    finally:
        cache.clear()
    picture = drawn[::-1].reshape(height, samples, width, samples, 4).mean(axis=(1, 3), dtype=np.float32)
    return picture if background is None else _over(picture, background)


@contextlib.contextmanager
def _offscreen(width: int, height: int) -> Iterator[gpu.types.GPUOffScreen]:
    """A bound, cleared RGBA32F target with depth, freed afterwards."""
    target = gpu.types.GPUOffScreen(width, height, format="RGBA32F")
    try:
        with target.bind():
            gpu.state.active_framebuffer_get().clear(color=(0.0, 0.0, 0.0, 0.0), depth=1.0)
            yield target
    finally:
        target.free()


def _over(picture: NDArray[np.float32], background: ArrayLike) -> NDArray[np.float32]:
    """A premultiplied picture (h, w, 4) over an opaque background, (3,) or (h, w, 3)."""
    behind = np.asarray(background, np.float32)
    if behind.shape != (3,) and behind.shape != (*picture.shape[:2], 3):
        raise ValueError(f"a background of shape {behind.shape} does not fit a picture of shape {picture.shape}")
    result = np.ones_like(picture)
    result[..., :3] = picture[..., :3] + (1.0 - picture[..., 3:]) * behind
    return result


def camera_view_projection(scene: bpy.types.Scene, width: int, height: int) -> NDArray[np.float64]:
    """(4, 4) from world to clip space of the scene's active camera.

    Raises BadScene without a usable camera, BadArguments for a size that no picture can have.
    """
    if not (0 < width <= LARGEST_TEXTURE and 0 < height <= LARGEST_TEXTURE):
        raise BadArguments("the preview", f"{width}x{height} pixels", f"Choose 1 to {LARGEST_TEXTURE} pixels per side")
    camera = scene.camera
    if camera is None:
        raise BadScene(f"scene {scene.name}", "it has no active camera", "Add one, or make one active (Ctrl Numpad 0)")
    if camera.type != "CAMERA" or camera.data.type not in {"PERSP", "ORTHO"}:
        raise BadScene(camera.name, "it is no perspective or orthographic camera", "Change its type")
    with bpy.context.temp_override(scene=scene, view_layer=scene.view_layers[0]):
        depsgraph = bpy.context.evaluated_depsgraph_get()
    projection = camera.calc_matrix_camera(
        depsgraph,
        x=width,
        y=height,
        scale_x=scene.render.pixel_aspect_x,
        scale_y=scene.render.pixel_aspect_y,
    )
    # Blender's cameras ignore their object's scale.
    placed = np.array(camera.evaluated_get(depsgraph).matrix_world.normalized(), np.float64)
    if not (np.isfinite(placed).all() and np.isfinite(projection).all()) or not np.linalg.det(placed):  # small
        raise BadScene(camera.name, "its place or scale makes no view", "Give it finite coordinates and a scale of one")
    return np.array(projection, np.float64) @ np.linalg.inv(placed)  # small


def camera_background(
    scene: bpy.types.Scene, sample: Callable[[NDArray[np.float64]], ArrayLike], width: int, height: int
) -> NDArray[np.float32]:
    """What the active camera sees of a distant environment: (height, width, 3), row 0 up.

    sample: radiance (n, 3) of unit world directions (n, 3) that point away from the camera.
    """
    return view_background(camera_view_projection(scene, width, height), sample, width, height)


def view_background(
    view_projection: NDArray[np.float64], sample: Callable[[NDArray[np.float64]], ArrayLike], width: int, height: int
) -> NDArray[np.float32]:
    """As `camera_background`, seen through any (4, 4) from world to clip space."""
    inverse = np.linalg.inv(view_projection)  # small
    columns = (np.arange(width) + 0.5) / width * 2.0 - 1.0
    rows = 1.0 - (np.arange(height) + 0.5) / height * 2.0
    # A pixel's points on the near and far planes are affine in its place; far - near is its direction, for
    # orthographic cameras too. Homogeneous: with clip planes very far apart the far one's w is rounded to 0, or below.
    picture = np.empty((height, width, 3), np.float32)
    for index, row in enumerate(rows):
        near, far = (_unproject(inverse, columns, row, depth) for depth in (-1.0, 1.0))
        directions = np.sign(near[:, 3:]) * (far[:, :3] * near[:, 3:] - near[:, :3] * far[:, 3:])
        picture[index] = sample(directions / np.sqrt((directions**2).sum(axis=1, keepdims=True)))
    return picture


def environment_sampler(
    image: NDArray[np.floating], rotation: ArrayLike | None = None
) -> Callable[[NDArray[np.float64]], NDArray[np.float32]]:
    """The `sample` of `camera_background` for an equirectangular image (h, w, 3), bilinear like Blender's.

    rotation: (3, 3) R of the environment, f(R^-1 s), as `environment.world_rotation` gives it.
    """
    height, width, _ = image.shape
    turn = np.eye(3) if rotation is None else np.asarray(rotation, np.float64)

    def sample(directions: NDArray[np.float64]) -> NDArray[np.float32]:
        # The pixel in a grid that is SUBPIXELS times finer is a place in pixels: the orientation stays in one module.
        row, column = pixel_of_direction(directions @ turn, height * SUBPIXELS, width * SUBPIXELS)  # small
        row, column = (row + 0.5) / SUBPIXELS - 0.5, (column + 0.5) / SUBPIXELS - 0.5
        top, left = np.floor(row).astype(np.intp), np.floor(column).astype(np.intp)
        down, right = (row - top)[:, None], (column - left)[:, None]
        rows = np.clip(top, 0, height - 1), np.clip(top + 1, 0, height - 1)
        columns = left % width, (left + 1) % width
        upper = image[rows[0], columns[0]] * (1 - right) + image[rows[0], columns[1]] * right
        lower = image[rows[1], columns[0]] * (1 - right) + image[rows[1], columns[1]] * right
        return (upper * (1 - down) + lower * down).astype(np.float32)

    return sample


def _unproject(inverse: NDArray[np.float64], columns: NDArray[np.float64], row: float, depth: float) -> NDArray:
    """Homogeneous world points (width, 4) of NDC (columns, row, depth)."""
    return columns[:, None] * inverse[:, 0] + row * inverse[:, 1] + depth * inverse[:, 2] + inverse[:, 3]


def write_png(path: Path, picture: NDArray[np.floating], scene: bpy.types.Scene) -> None:
    """Save a scene-linear picture (height, width, 4), row 0 up, as an 8 bit PNG with the scene's view transform.

    Fully opaque pictures become RGB. The file is complete or absent. Raises StorageError where it can't be written.
    """
    content = png_bytes(picture, scene)
    write_atomically(path, lambda stream: stream.write(content) and None)


def png_bytes(picture: NDArray[np.floating], scene: bpy.types.Scene) -> bytes:
    """A scene-linear picture (height, width, 4), row 0 up, as an 8 bit PNG with the scene's view transform."""
    height, width, _ = picture.shape
    image = bpy.data.images.new("PRT preview", width, height, alpha=True, float_buffer=True)
    try:
        image.pixels.foreach_set(np.ascontiguousarray(picture[::-1], np.float32).reshape(-1))
        opaque = bool((picture[..., 3] == 1.0).all())
        with tempfile.TemporaryDirectory() as folder, _png_settings(scene, "RGB" if opaque else "RGBA"):
            beside = Path(folder) / "preview.png"
            image.save_render(str(beside), scene=scene)
            return beside.read_bytes()
    finally:
        bpy.data.images.remove(image)


@contextlib.contextmanager
def _png_settings(scene: bpy.types.Scene, color_mode: str) -> Iterator[None]:
    """The scene's output settings as an 8 bit PNG of the scene's own colour management; put back afterwards."""
    settings = scene.render.image_settings
    wanted = {
        "media_type": "IMAGE",
        "file_format": "PNG",
        "color_mode": color_mode,
        "color_depth": "8",
        "color_management": "FOLLOW_SCENE",
    }
    before = {name: getattr(settings, name) for name in wanted if hasattr(settings, name)}
    # Blender sets it along with the format; of some formats it has none, and warns of asking for it.
    space = "" if settings.file_format == "PNG" else settings.linear_colorspace_settings.name
    try:
        for name in before:
            setattr(settings, name, wanted[name])
        yield
    finally:
        for name, value in before.items():
            setattr(settings, name, value)
        if space:
            settings.linear_colorspace_settings.name = space
