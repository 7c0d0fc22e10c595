# SPDX-License-Identifier: GPL-3.0-or-later
"""The shaders against the definition of the container, computed by numpy in double precision."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bpy
import numpy as np
import pytest

from tests.blender import gpu_support  # makes the checkout the package `prt`

# isort: split
from prt.gpu_shaders import draw, offscreen, programs, render_data
from prt.prt_addon.errors import BadArguments, BadScene, PRTError
from prt.prt_addon.relighting.exit_radiance import cluster_constants

SIZE = 100  # pixels per side of the test pictures
TOLERANCE = 2e-3  # of the brightest value


@pytest.fixture(autouse=True, scope="module")
def graphics() -> Iterator[None]:
    gpu_support.require_gpu()
    yield
    programs.release()


@pytest.fixture
def scene() -> bpy.types.Scene:
    """An empty scene with an orthographic camera that looks down on -1..1: pixel centres are known in world space."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    camera.data.type = "ORTHO"
    camera.data.ortho_scale = 2.2
    camera.location = (0.0, 0.0, 5.0)
    scene.collection.objects.link(camera)
    scene.camera = camera
    bpy.context.view_layer.update()
    return scene


def bake(side: int = 9, seed: int = 5, **options: int) -> tuple[Any, np.ndarray]:
    generator = np.random.default_rng(seed)
    baked = gpu_support.made_up_bake(*gpu_support.grid_mesh(side, generator), generator, **options)
    return baked, gpu_support.bright_light(options.get("columns", 25), generator)


def interpolated(baked: Any, colours: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values (n, c) of per-point colours (p, c) at places (n, 2) seen from above, and whether each is well inside."""
    corners = baked.positions[baked.triangles][:, :, :2].astype(np.float64)  # (t, 3, 2)
    edges = corners[:, 1:] - corners[:, :1]
    determinant = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
    offset = places[:, None, :] - corners[None, :, 0]
    u = (offset[..., 0] * edges[:, 1, 1] - offset[..., 1] * edges[:, 1, 0]) / determinant
    v = (edges[:, 0, 0] * offset[..., 1] - edges[:, 0, 1] * offset[..., 0]) / determinant
    barycentric = np.stack([1.0 - u - v, u, v], axis=-1)  # (n, t, 3)
    inside = barycentric.min(axis=2)
    triangle = inside.argmax(axis=1)
    chosen = barycentric[np.arange(len(places)), triangle]
    return np.einsum("nk,nkc->nc", chosen, colours[baked.triangles[triangle]]), inside.max(axis=1) > 1e-3


def pixel_places() -> np.ndarray:
    """World x, y of the pixel centres, (SIZE * SIZE, 2), row 0 up."""
    ticks = ((np.arange(SIZE) + 0.5) / SIZE - 0.5) * 2.2
    x, y = np.meshgrid(ticks, -ticks)
    return np.stack([x, y], axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("vectors", [0, 1, 3, 8, 24])
def test_picture_equals_interpolated_radiance_times_albedo(scene: Any, vectors: int, channels: int) -> None:
    baked, light = bake(clusters=7, vectors=vectors, channels=channels)
    picture = offscreen.draw_camera(scene, [(baked, np.eye(4))], light, SIZE, SIZE, samples=1)
    radiance = gpu_support.expected_radiance(baked, light)[:, 0]
    assert radiance.min() > 0  # nothing clipped: every number takes part
    both, well_inside = interpolated(baked, np.concatenate([radiance, baked.albedo], axis=1), pixel_places())
    expected = both[:, :3] * both[:, 3:]
    error = np.abs(picture.reshape(-1, 4)[well_inside, :3] - expected[well_inside]).max()
    assert well_inside.sum() > 0.7 * SIZE**2
    assert error < TOLERANCE * expected.max()
    assert np.array_equal(np.unique(picture[..., 3]), [0.0, 1.0])


@pytest.mark.parametrize("clusters", [1, 64, 500])
@pytest.mark.parametrize(("vectors", "channels", "rows"), [(0, 3, 1), (3, 1, 1), (4, 1, 1), (24, 3, 1), (8, 1, 16)])
def test_exit_radiance_of_every_point(clusters: int, vectors: int, channels: int, rows: int) -> None:
    baked, light = bake(61, clusters=clusters, vectors=vectors, channels=channels, rows=rows, columns=9)
    drawing = draw.ObjectDrawing(render_data.make_render_data(baked))
    drawing.relight(cluster_constants(baked.bases, light.astype(np.float32)))
    expected = gpu_support.expected_radiance(baked, light)
    assert np.abs(drawing.exit_radiances() - expected).max() < 1e-5 * np.abs(expected).max()


def test_a_million_points() -> None:
    generator = np.random.default_rng(8)
    points = generator.uniform(-1, 1, (1_000_000, 3)).astype(np.float32)
    triangles = np.array([[0, 1, 999_999]], np.int32)
    baked = gpu_support.made_up_bake(points, triangles, generator, clusters=300, vectors=3, columns=4)
    light = gpu_support.bright_light(4, generator)
    drawing = draw.ObjectDrawing(render_data.make_render_data(baked))
    drawing.relight(cluster_constants(baked.bases, light.astype(np.float32)))
    expected = gpu_support.expected_radiance(baked, light)
    assert np.abs(drawing.exit_radiances() - expected).max() < 1e-5 * np.abs(expected).max()


def test_perspective_camera_sees_points_where_blender_projects_them(scene: Any) -> None:
    from bpy_extras.object_utils import world_to_camera_view
    from mathutils import Vector

    camera = scene.camera
    camera.data.type = "PERSP"
    camera.data.shift_x = 0.1
    camera.location, camera.rotation_euler, camera.scale = (1.0, -2.0, 3.0), (0.55, 0.1, 0.4), (2.0, 2.0, 2.0)
    bpy.context.view_layer.update()
    matrix = offscreen.camera_view_projection(scene, 320, 180)
    scene.render.resolution_x, scene.render.resolution_y = 320, 180
    for point in ((0, 0, 0), (0.5, 0.2, -0.3), (-0.7, 0.4, 0.1)):
        clip = matrix @ (*point, 1.0)
        expected = world_to_camera_view(scene, camera, Vector(point))
        assert (clip[:2] / clip[3] + 1.0) / 2.0 == pytest.approx(expected[:2], abs=1e-5)


def test_nearer_surface_hides_the_farther_and_matrix_moves(scene: Any) -> None:
    lower, light = bake()
    upper, _ = bake(seed=6)
    raised = np.eye(4)
    raised[:3, 3] = (1.0, 0.0, 0.5)
    alone = offscreen.draw_camera(scene, [(upper, raised)], light, SIZE, SIZE)
    below = offscreen.draw_camera(scene, [(lower, np.eye(4))], light, SIZE, SIZE)
    for order in (1, -1):
        pair = [(lower, np.eye(4)), (upper, raised)][::order]
        both = offscreen.draw_camera(scene, pair, light, SIZE, SIZE)
        covered, free = alone[..., 3] == 1.0, alone[..., 3] == 0.0
        assert np.array_equal(both[covered], alone[covered])
        assert np.array_equal(both[free], below[free])
    assert not covered[:, : SIZE // 2 - 2].any() and covered[SIZE // 2, SIZE // 2 + 2 : -12].all()


def test_exposure_dimming_black_clipping_and_heat(scene: Any) -> None:
    baked, light = bake()

    def centre(**options: Any) -> np.ndarray:
        lit = options.pop("light", light)
        item = render_data.DrawItem("key", baked, np.eye(4), lit, **options)
        return offscreen.draw_items(scene, [item], SIZE, SIZE)[SIZE // 2, SIZE // 2, :3]

    plain = centre()
    assert centre(exposure=2.0) == pytest.approx(2.0 * plain, rel=1e-6)
    assert centre(stale=True) == pytest.approx(draw.STALE_DIMMING * plain, rel=1e-6)
    assert np.array_equal(centre(light=-light), [0.0, 0.0, 0.0])
    assert centre(heat=np.ones(len(baked.positions))) == pytest.approx([1.0, 1.0, 1.0])


def test_samples_are_averaged_in_scene_linear(scene: Any) -> None:
    scene.camera.rotation_euler = (0.0, 0.0, 0.3)
    baked, light = bake()
    fine = offscreen.draw_camera(scene, [(baked, np.eye(4))], light, SIZE * 2, SIZE * 2, samples=1)
    picture = offscreen.draw_camera(scene, [(baked, np.eye(4))], light, SIZE, SIZE, samples=2)
    assert np.allclose(picture, fine.reshape(SIZE, 2, SIZE, 2, 4).mean(axis=(1, 3)), atol=1e-6)
    assert ((picture[..., 3] > 0) & (picture[..., 3] < 1)).any()  # soft edges


@pytest.mark.parametrize(("start", "end"), [(1e-5, 100.0), (1e-6, 1e5)])
def test_background_does_not_depend_on_the_clip_planes(scene: Any, start: float, end: float) -> None:
    camera = scene.camera.data
    camera.type, scene.camera.rotation_euler, scene.camera.location = "PERSP", (1.2, 0.1, 0.4), (0.0, -0.006, 0.001)
    bpy.context.view_layer.update()
    wanted = offscreen.camera_background(scene, lambda d: d, 16, 8)
    before = camera.clip_start, camera.clip_end
    camera.clip_start, camera.clip_end = start, end
    bpy.context.view_layer.update()
    found = offscreen.camera_background(scene, lambda d: d, 16, 8)
    camera.clip_start, camera.clip_end = before
    assert np.abs(found - wanted).max() < 1e-4


def test_background_is_seen_behind_and_its_directions_are_the_cameras(scene: Any) -> None:
    scene.camera.data.type = "PERSP"
    scene.camera.rotation_euler = (np.pi / 2, 0.0, 0.0)  # looks along +Y, Z up
    bpy.context.view_layer.update()
    directions = offscreen.camera_background(scene, lambda d: d, 64, 32)
    assert np.allclose((directions**2).sum(axis=-1), 1.0, atol=1e-6)
    assert directions[15:17, 31:33].mean(axis=(0, 1)) == pytest.approx([0, 1, 0], abs=1e-3)
    assert (np.diff(directions[..., 0], axis=1) > 0).all()  # +X to the right
    assert (np.diff(directions[..., 2], axis=0) < 0).all()  # +Z up, row 0 up
    half_width = directions[16, -1, 0] / directions[16, -1, 1]
    assert half_width == pytest.approx(np.tan(scene.camera.data.angle_x / 2) * 63 / 64, rel=1e-3)
    scene.camera.data.type = "ORTHO"
    scene.camera.rotation_euler = (0.0, 0.0, 0.0)
    bpy.context.view_layer.update()
    assert offscreen.camera_background(scene, lambda d: d, 4, 4) == pytest.approx(np.tile([0, 0, -1], (4, 4, 1)))
    baked, light = bake()
    behind = np.random.default_rng(1).uniform(0, 1, (SIZE, SIZE, 3)).astype(np.float32)
    picture = offscreen.draw_camera(scene, [(baked, np.eye(4))], light, SIZE, SIZE, behind)
    clear = offscreen.draw_camera(scene, [(baked, np.eye(4))], light, SIZE, SIZE)
    assert (picture[..., 3] == 1).all()
    assert np.allclose(picture[..., :3], clear[..., :3] + (1 - clear[..., 3:]) * behind, atol=1e-6)
    plain = offscreen.draw_camera(scene, [], light, 8, 4, background=(0.1, 0.2, 0.3))
    assert plain == pytest.approx(np.tile(np.array([0.1, 0.2, 0.3, 1.0], np.float32), (4, 8, 1)))


def test_environment_is_looked_up_where_its_light_comes_from() -> None:
    """An environment whose radiance is its own direction gives back what it is asked, turned by its rotation."""
    from prt.prt_addon.lighting.environment import direction_of_pixel, world_rotation

    rows, columns = np.meshgrid(np.arange(128), np.arange(256), indexing="ij")
    image = direction_of_pixel(rows, columns, 128, 256)
    asked = np.random.default_rng(4).normal(size=(500, 3))
    asked /= np.linalg.norm(asked, axis=1, keepdims=True)
    assert np.allclose(offscreen.environment_sampler(image)(asked), asked, atol=1e-3)
    turn = world_rotation(70.0)
    turned = offscreen.environment_sampler(image, turn)(asked)
    assert np.allclose(turned, asked @ turn, atol=1e-3)  # f(R^-1 s)


def test_objects_are_built_once_and_relit_only_when_the_light_changes(monkeypatch: pytest.MonkeyPatch) -> None:
    built: list[int] = []
    lit: list[int] = []
    build, relight = draw.ObjectDrawing.__init__, draw.ObjectDrawing.relight
    monkeypatch.setattr(draw.ObjectDrawing, "__init__", lambda self, data: (built.append(1), build(self, data))[1])
    monkeypatch.setattr(draw.ObjectDrawing, "relight", lambda self, c: (lit.append(1), relight(self, c))[1])
    baked, light = bake(vectors=3, clusters=4)
    cache = draw.DrawingCache()
    with offscreen._offscreen(8, 8):
        for frame in range(6):
            item = render_data.DrawItem("key", baked, np.eye(4), light * (1 + frame // 2), exposure=float(frame))
            cache.draw([item, item], np.eye(4))
    assert (len(built), len(lit)) == (1, 3)
    cache.keep_only({"key"})
    assert len(cache) == 1
    cache.keep_only(set())
    assert len(cache) == 0


def test_light_changes_leak_no_textures() -> None:
    baked, light = bake(21, vectors=24, clusters=400)
    cache = draw.DrawingCache()
    resident = []
    with offscreen._offscreen(8, 8):
        for frame in range(200):
            cache.draw([render_data.DrawItem("key", baked, np.eye(4), light * (1 + frame))], np.eye(4))
            if frame in (50, 199):
                resident.append(_resident_bytes())
    cache.clear()
    constants = 400 * 25 * 16  # bytes of one light's texture
    assert resident[1] - resident[0] < 150 * constants / 4


def _resident_bytes() -> int:
    pages = Path("/proc/self/statm")
    if not pages.exists():
        pytest.skip("resident memory is read from /proc")
    return int(pages.read_text().split()[1]) * 4096


def test_same_picture_twice_to_the_last_bit(scene: Any) -> None:
    baked, light = bake(clusters=5, vectors=8)
    first, second = (offscreen.draw_camera(scene, [(baked, np.eye(4))], light, 64, 64) for _ in range(2))
    assert np.array_equal(first, second)


def test_wrong_cameras_sizes_and_lights_are_refused_in_words(scene: Any) -> None:
    baked, light = bake()
    with pytest.raises(BadScene, match="the light"):
        offscreen.draw_camera(scene, [(baked, np.eye(4))], light[:4], 8, 8)
    for size in ((0, 10), (10, 20000)):
        with pytest.raises(BadArguments, match="pixels"):
            offscreen.draw_camera(scene, [], light, *size)
    scene.camera.data.type = "PANO"
    with pytest.raises(BadScene, match="Camera"):
        offscreen.draw_camera(scene, [], light, 8, 8)
    scene.camera = None
    with pytest.raises(BadScene, match="no active camera"):
        offscreen.draw_camera(scene, [], light, 8, 8)


def test_png_has_the_scenes_view_transform_and_leaves_the_scene_alone(scene: Any, tmp_path: Path) -> None:
    """AgX keeps room above 1 and takes bright red towards white; Standard is sRGB's transfer function, clipped."""
    scene.view_settings.view_transform = "AgX"
    scene.render.dither_intensity = 0.0
    scene.render.image_settings.file_format = "OPEN_EXR"
    picture = np.ones((4, 6, 4), np.float32)
    picture[..., :3] = 0.18
    picture[1, 1, :3] = 1.0
    picture[0, 0, :3] = (4.0, 0.0, 0.0)  # the top left
    path = tmp_path / "picture.png"
    images = len(bpy.data.images)
    offscreen.write_png(path, picture, scene)
    assert scene.render.image_settings.file_format == "OPEN_EXR"
    assert len(bpy.data.images) == images
    assert [p.name for p in tmp_path.iterdir()] == ["picture.png"]
    agx = _read_png(path)
    assert agx.shape == (4, 6, 4)
    assert agx[0, 0, 0] > 0.8 and agx[0, 0, 1] > 0.0  # AgX takes bright red towards white
    scene.view_settings.view_transform = "Standard"
    offscreen.write_png(path, picture, scene)
    standard = _read_png(path)
    assert standard[3, 5, :3] == pytest.approx([0.4613] * 3, abs=1 / 255)  # sRGB's transfer function of 0.18
    assert standard[0, 0, :3] == pytest.approx([1.0, 0.0, 0.0], abs=1 / 255)
    assert standard[1, 1, 0] == 1.0 and 0.6 < agx[1, 1, 0] < 0.95  # AgX keeps room above white


def test_transparent_png_keeps_colours_apart_from_alpha(scene: Any, tmp_path: Path) -> None:
    scene.view_settings.view_transform = "Standard"
    scene.render.dither_intensity = 0.0
    picture = np.zeros((2, 2, 4), np.float32)
    picture[0, 0] = (0.5, 0.25, 0.0, 0.5)  # premultiplied: the colour is (1, 0.5, 0)
    offscreen.write_png(tmp_path / "p.png", picture, scene)
    read = _read_png(tmp_path / "p.png")
    assert read[0, 0] == pytest.approx([1.0, 0.7354, 0.0, 0.5], abs=2 / 255)
    assert read[1, 1, 3] == 0.0


def test_unwritable_png_is_refused_by_name(scene: Any, tmp_path: Path) -> None:
    with pytest.raises(PRTError, match="missing"):
        offscreen.write_png(tmp_path / "missing" / "p.png", np.ones((2, 2, 4), np.float32), scene)


def _read_png(path: Path) -> np.ndarray:
    """The file's own values (h, w, 4) in 0..1, row 0 up, read as data."""
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.name = "Non-Color"
    image.alpha_mode = "CHANNEL_PACKED"
    width, height = image.size
    values = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(values)
    bpy.data.images.remove(image)
    return values.reshape(height, width, 4)[::-1]
