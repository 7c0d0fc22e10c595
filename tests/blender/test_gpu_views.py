# SPDX-License-Identifier: GPL-3.0-or-later
"""View-dependent transfer on the GPU, pixel by pixel, against the CPU's relighting."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from tests.blender import gpu_support  # makes the checkout the package `prt`

# isort: split
from prt.gpu_shaders import draw, hemisphere_glsl, offscreen, programs, render_data
from prt.prt_addon.basis.spherical_harmonics import rotation
from prt.prt_addon.relighting.exit_radiance import cluster_constants, combine_rows, hemisphere_values, view_radiance

SIZE = 90
TOLERANCE = 2e-3  # of the brightest value
ROW_SETS = {"1": (0,), "4": tuple(range(4)), "9": tuple(range(9)), "16": tuple(range(16)),
            "24": (0, 1, *range(3, 25)), "25": tuple(range(25))}


@pytest.fixture(autouse=True, scope="module")
def graphics() -> Iterator[None]:
    gpu_support.require_gpu()
    yield
    programs.release()


@pytest.fixture
def scene() -> bpy.types.Scene:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    scene.collection.objects.link(scene.camera)
    return scene


def aim(scene: bpy.types.Scene, kind: str, location: tuple[float, float, float] = (0.8, -1.4, 1.9)) -> None:
    """The camera at a place from which it sees the middle of the world."""
    from mathutils import Vector

    scene.camera.data.type, scene.camera.data.ortho_scale = kind, 2.4
    scene.camera.location = location
    scene.camera.rotation_euler = Vector(location).to_track_quat("Z", "Y").to_euler()
    bpy.context.view_layer.update()


def glossy(functions: tuple[int, ...], seed: int = 3, side: int = 9, **options: Any) -> tuple[Any, np.ndarray]:
    generator = np.random.default_rng(seed)
    options = {"clusters": 5, "vectors": 4, "columns": 16, "channels": 3, **options}
    baked = gpu_support.made_up_bake(*gpu_support.grid_mesh(side, generator), generator, functions=functions, **options)
    return baked, gpu_support.bright_light(options["columns"], generator)


def rays(view_projection: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points on the near and far plane (SIZE * SIZE, 3) of every pixel's centre, row 0 up."""
    ticks = (np.arange(SIZE) + 0.5) / SIZE * 2.0 - 1.0
    x, y = np.meshgrid(ticks, -ticks)
    ends = []
    for depth in (-1.0, 1.0):
        ndc = np.stack([x.ravel(), y.ravel(), np.full(x.size, depth), np.ones(x.size)], axis=1)
        world = ndc @ np.linalg.inv(view_projection).T
        ends.append(world[:, :3] / world[:, 3:])
    return ends[0], ends[1]


def hits(positions: np.ndarray, triangles: np.ndarray, start: np.ndarray, end: np.ndarray,
         ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nearest triangle (n,) that each ray meets, barycentric coordinates (n, 3), and whether well inside of it."""
    corners = positions[triangles].astype(np.float64)
    edge_1, edge_2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(edge_1, edge_2)
    direction = end - start
    to_start = start[:, None] - corners[None, :, 0]
    determinant = -direction @ normal.T
    turned = np.cross(to_start, direction[:, None])
    u = np.einsum("ntk,tk->nt", turned, edge_2) / determinant
    v = -np.einsum("ntk,tk->nt", turned, edge_1) / determinant
    along = np.einsum("ntk,tk->nt", to_start, normal) / determinant
    weights = np.stack([1.0 - u - v, u, v], axis=2)
    inside = weights.min(axis=2)
    along = np.where(inside > -1e-9, along, np.inf)
    nearest = along.argmin(axis=1)
    rows = np.arange(len(start))
    near_edge = (np.abs(inside) < 2e-3).any(axis=1)  # of any triangle: the pixel may show its neighbour
    return nearest, weights[rows, nearest], np.isfinite(along[rows, nearest]) & ~near_edge


def oracle(baked: Any, light: np.ndarray, view_projection: np.ndarray, matrix: np.ndarray,
           ) -> tuple[np.ndarray, np.ndarray]:
    """Radiance (n, 3) of every pixel from interpolated rows and frames, and which pixels are well inside a triangle.

    The viewer is found from the pixels' own rays: where they meet, or how they run.
    """
    moved = baked.positions @ matrix[:3, :3].T + matrix[:3, 3]
    start, end = rays(view_projection)
    triangle, weights, well_inside = hits(moved, baked.triangles, start, end)
    corners = baked.triangles[triangle]
    rows = gpu_support.expected_radiance(baked, light)
    to_baked = np.linalg.inv(matrix)
    if np.allclose(end - start, (end - start)[0], atol=1e-9):
        to_viewer = np.broadcast_to(to_baked[:3, :3] @ (start - end)[0], baked.positions.shape)
    else:
        spread = end - start
        projectors = np.eye(3) - spread[:, :, None] * spread[:, None] / np.sum(spread ** 2, axis=1)[:, None, None]
        eye = np.linalg.solve(projectors.sum(axis=0), np.einsum("nij,nj->i", projectors, start))
        to_viewer = to_baked[:3, :3] @ eye + to_baked[:3, 3] - baked.positions

    def mixed(values: np.ndarray) -> np.ndarray:
        return np.einsum("nk,nk...->n...", weights, values)

    unique, place = np.unique(corners, axis=0, return_inverse=True)
    turned, local = (values[place.ravel()] for values in in_shared_frames(baked, rows, to_viewer, unique))
    values = hemisphere_values(baked.functions, mixed(local))
    return combine_rows(mixed(turned), mixed(baked.albedo[corners].astype(np.float64)), values), well_inside


def in_shared_frames(baked: Any, rows: np.ndarray, to_viewer: np.ndarray, corners: np.ndarray,
                     ) -> tuple[np.ndarray, np.ndarray]:
    """Rows (n, 3, rows, 3) and local views (n, 3, 3) of triangles' corners (n, 3), all three in the first one's frame
    where frames turn by more than LARGEST_TURN, by rotations and their matrices of spherical harmonics."""
    order = int(np.sqrt(max(baked.functions))) + 1
    turned, local = rows[corners].astype(np.float64), np.empty((*corners.shape, 3))
    for pixel, triangle in enumerate(corners):
        frames = [np.array([t, np.cross(n, t), n]) for t, n in zip(
            baked.tangents[triangle].astype(np.float64), baked.normals[triangle].astype(np.float64), strict=True)]
        turns = []
        for frame in frames:
            # The smallest rotation that takes the first normal to this one, then the angle in this one's plane.
            axis, cosine = np.cross(frames[0][2], frame[2]), frames[0][2] @ frame[2]
            skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
            carried = (np.eye(3) + skew + skew @ skew / (1 + cosine)) @ frames[0][0]
            turns.append(np.arctan2(carried @ frame[1], carried @ frame[0]))
        if max(np.abs(turns)) > render_data.LARGEST_TURN:
            for corner, exact in enumerate(turns):
                turn = np.rint(exact / render_data.TURN_STEP) * render_data.TURN_STEP
                back = np.array([[np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
                frames[corner] = back @ frames[corner]
                matrix = rotation(order, back)[np.ix_(baked.functions, baked.functions)]
                turned[pixel, corner, 1:] = matrix @ turned[pixel, corner, 1:]
        for corner, point in enumerate(triangle):
            local[pixel, corner] = frames[corner] @ to_viewer[point]
    return turned, local


def compare(scene: bpy.types.Scene, baked: Any, light: np.ndarray, matrix: np.ndarray | None = None,
            least: float = 0.25) -> None:
    matrix = np.eye(4) if matrix is None else matrix
    picture = offscreen.draw_camera(scene, [(baked, matrix)], light, SIZE, SIZE, samples=1)
    expected, well_inside = oracle(baked, light, offscreen.camera_view_projection(scene, SIZE, SIZE), matrix)
    assert well_inside.mean() > least
    expected = expected[well_inside]
    assert expected.std(axis=0).min() > 0.05 * expected.max()  # there is something to see
    assert (expected > 0.0).mean() > 0.5
    found = picture.reshape(-1, 4)[well_inside, :3]
    assert np.abs(found - np.maximum(expected, 0.0)).max() < TOLERANCE * expected.max()


@pytest.mark.parametrize("kind", ["PERSP", "ORTHO"])
@pytest.mark.parametrize("rows", ROW_SETS)
def test_picture_equals_the_cpus_relighting(scene: bpy.types.Scene, rows: str, kind: str) -> None:
    aim(scene, kind)
    compare(scene, *glossy(ROW_SETS[rows]))


MOVES = {
    "rigid": Matrix.Translation((0.3, 0.1, -0.4)) @ Matrix.Rotation(0.8, 4, "Z") @ Matrix.Rotation(0.4, 4, "X"),
    "scaled": Matrix.Diagonal((0.7, 1.3, 2.0, 1.0)),
    "mirrored": Matrix.Diagonal((-1.0, 1.2, 1.0, 1.0)),
    "far": Matrix.Translation((1000.0, 0.0, 0.0)),
}


@pytest.mark.parametrize("kind", ["PERSP", "ORTHO"])
@pytest.mark.parametrize("move", ["rigid", "scaled", "mirrored"])
def test_objects_moved_since_the_bake(scene: bpy.types.Scene, move: str, kind: str) -> None:
    aim(scene, kind)
    compare(scene, *glossy(ROW_SETS["16"]), np.array(MOVES[move]))


@pytest.mark.parametrize("kind", ["PERSP", "ORTHO"])
def test_back_faces_and_grazing_views_are_mirrored_to_the_front(scene: bpy.types.Scene, kind: str) -> None:
    aim(scene, kind, (0.5, -1.0, -2.0))
    compare(scene, *glossy(ROW_SETS["9"]))
    aim(scene, kind, (0.2, -2.5, 0.25))
    compare(scene, *glossy(ROW_SETS["9"]), least=0.02)


def test_vertices_show_what_view_radiance_says(scene: bpy.types.Scene) -> None:
    """A flat-coloured triangle for each receiver: interpolation has no part in it."""
    baked, light = glossy(ROW_SETS["24"], side=5)
    owner = baked.triangles.ravel()
    corners = baked.positions[baked.triangles]
    spread = {name: np.repeat(getattr(baked, name)[owner[::3]], 3, axis=0)
              for name in ("cluster", "weights", "albedo", "normals", "tangents")}
    split = dataclasses.replace(baked, **spread, positions=corners.reshape(-1, 3),
                                triangles=np.arange(len(owner), dtype=np.int32).reshape(-1, 3))
    aim(scene, "ORTHO", (0.3, -0.4, 2.0))
    picture = offscreen.draw_camera(scene, [(split, np.eye(4))], light, SIZE, SIZE, samples=1).reshape(-1, 4)
    start, end = rays(offscreen.camera_view_projection(scene, SIZE, SIZE))
    triangle, _, well_inside = hits(split.positions, split.triangles, start, end)
    expected = view_radiance(split, light, np.broadcast_to(start[0] - end[0], split.positions.shape))[triangle * 3]
    error = np.abs(picture[well_inside, :3] - np.maximum(expected[well_inside], 0.0)).max()
    assert error < 1e-3 * expected.max()


def test_diffuse_and_glossy_objects_together_and_programs_are_shared(scene: bpy.types.Scene,
                                                                     monkeypatch: pytest.MonkeyPatch) -> None:
    programs.release()
    aim(scene, "PERSP", (0.0, -0.5, 3.5))
    shiny, light = glossy(ROW_SETS["9"])
    other, _ = glossy(ROW_SETS["9"], seed=8)
    matt, _ = glossy((), seed=4)
    places = [np.array(Matrix.Translation((x, 0, 0)) @ Matrix.Diagonal((0.4, 0.4, 0.4, 1))) for x in (-0.9, 0.0, 0.9)]
    pairs = list(zip((shiny, matt, other), places, strict=True))
    together = offscreen.draw_camera(scene, pairs, light, SIZE, SIZE)
    alone = [offscreen.draw_camera(scene, [pair], light, SIZE, SIZE) for pair in pairs]
    assert np.allclose(together, np.sum(alone, axis=0), atol=1e-6)
    assert programs.view_surface.cache_info().currsize == 1

    def never(*arguments: object) -> None:
        raise AssertionError("a diffuse bake used the program of view-dependent ones")

    monkeypatch.setattr(programs, "view_surface", never)
    offscreen.draw_camera(scene, pairs[1:2], light, SIZE, SIZE)


def test_receivers_without_view_dependence_look_the_same_from_everywhere(scene: bpy.types.Scene) -> None:
    """Diffuse and glossy clusters in one mesh: the diffuse ones have rows of zero."""
    baked, light = glossy(ROW_SETS["16"], clusters=2)
    left = baked.positions[:, 0] < 0.01
    baked.cluster[:] = np.where(left, 0, 1)
    baked.bases[0, :, 1:] = 0.0
    flat = dataclasses.replace(baked, bases=np.ascontiguousarray(baked.bases[:, :, :1]),
                               header={**baked.header, "rows": {"kind": "constant"}}, tangents=None)
    aim(scene, "ORTHO", (0.0, 0.0, 3.0))
    scene.camera.rotation_euler = (0.0, 0.0, 0.0)  # x to the right
    bpy.context.view_layer.update()
    picture, plain = (offscreen.draw_camera(scene, [(b, np.eye(4))], light, SIZE, SIZE) for b in (baked, flat))
    columns = np.arange(SIZE) < SIZE // 2 - 2
    assert np.allclose(picture[:, columns], plain[:, columns], atol=1e-4)
    assert np.abs(picture[:, ~columns] - plain[:, ~columns]).max() > 0.05


def test_heat_and_dimming_of_view_dependent_bakes(scene: bpy.types.Scene) -> None:
    baked, light = glossy(ROW_SETS["9"])
    aim(scene, "ORTHO", (0.0, 0.0, 3.0))

    def middle(**options: Any) -> np.ndarray:
        item = render_data.DrawItem("key", baked, np.eye(4), light, **options)
        return offscreen.draw_items(scene, [item], SIZE, SIZE)[SIZE // 2, SIZE // 2, :3]

    assert middle(heat=np.ones(len(baked.positions))) == pytest.approx([1.0, 1.0, 1.0])
    assert middle(stale=True) == pytest.approx(draw.STALE_DIMMING * middle(), rel=1e-5)
    assert middle(exposure=3.0) == pytest.approx(3.0 * middle(), rel=1e-5)


def test_a_cluster_sums_its_own_vectors_only() -> None:
    """What lies beyond a cluster's vectors is not read, so that adapted numbers of vectors save work."""
    baked, light = glossy(ROW_SETS["9"], clusters=3, vectors=7)
    for cluster, own in enumerate((0, 3, 7)):
        baked.bases[cluster, 1 + own:] = 0.0
    data = render_data.make_render_data(baked)
    assert data.cluster_vectors.tolist() == [0, 3, 7]
    constants = cluster_constants(baked.bases, light.astype(np.float32))
    for cluster, own in enumerate((0, 3, 7)):
        constants[cluster, 1 + own:] = 1e6  # would show if it were read
    drawing = draw.ObjectDrawing(data)
    drawing.relight(constants)
    expected = gpu_support.expected_radiance(baked, light)
    assert np.abs(drawing.exit_radiances() - expected).max() < 1e-5 * np.abs(expected).max()


@pytest.mark.parametrize("kind", ["PERSP", "ORTHO"])
def test_the_viewer_is_found_in_the_transform(scene: bpy.types.Scene, kind: str) -> None:
    for location in ((0.8, -1.4, 1.9), (300.0, 20.0, -7.0), (1e-3, 0.0, 2e-3)):
        aim(scene, kind, location)
        view_projection = offscreen.camera_view_projection(scene, 320, 180)
        direction = np.array(location) / np.linalg.norm(location)
        expected = np.append(location, 1.0) if kind == "PERSP" else np.append(direction, 0.0)
        size = np.abs(expected).max()
        assert np.allclose(render_data.viewer_of(view_projection), expected, atol=1e-5 * size)
        biased = render_data.clip_transform(view_projection, np.eye(4))
        assert np.allclose(render_data.viewer_of(biased), expected, atol=1e-5 * size)
        for move in MOVES.values():
            moved = render_data.viewer_of(render_data.clip_transform(view_projection, np.array(move)))
            wanted = np.linalg.inv(np.array(move)) @ expected
            wanted = wanted if kind == "PERSP" else wanted / np.linalg.norm(wanted)
            assert np.allclose(moved, wanted, atol=1e-5 * max(np.abs(wanted).max(), size))


def test_a_flattened_object_breaks_nothing(scene: bpy.types.Scene) -> None:
    aim(scene, "PERSP")
    baked, light = glossy(ROW_SETS["9"])
    for scale in ((0.0, 1.0, 1.0), (0.0, 0.0, 0.0)):
        picture = offscreen.draw_camera(scene, [(baked, np.diag([*scale, 1.0]))], light, 16, 16)
        assert np.isfinite(picture).all()


def test_signature_follows_what_view_dependent_drawing_reads() -> None:
    baked, _ = glossy(ROW_SETS["9"])
    signature = render_data.transfer_signature(baked)
    for name in ("normals", "tangents"):
        changed = getattr(baked, name).copy()
        changed[3] *= -1.0
        assert render_data.transfer_signature(dataclasses.replace(baked, **{name: changed})) != signature
    rows = {**baked.header["rows"], "functions": [*range(8), 9]}
    renamed = dataclasses.replace(baked, header={**baked.header, "rows": rows})
    assert render_data.transfer_signature(renamed) != signature


def test_every_function_is_written_as_its_own_polynomial() -> None:
    """The GLSL of each function, read as Python, against the basis of the CPU, to order 6."""
    directions = np.random.default_rng(5).normal(size=(40, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions[:, 2] = np.abs(directions[:, 2])
    functions = tuple(range(36))
    lines = hemisphere_glsl.sum_rows(functions).split("\n")[2:]
    code = "\n".join(line.replace("float ", "").strip(" ;") for line in lines if " = " in line)
    total = " ".join(lines).split("return ")[1].split(";")[0]
    expected = hemisphere_values(functions, directions)
    for index in functions:
        names: dict[str, Any] = {"view": type("View", (), dict(zip("xyz", directions.T, strict=True)))}
        names |= {f"row_{k}": float(k == index) for k in functions}
        exec(code, names)
        assert np.allclose(eval(total, names), expected[:, index], atol=1e-12)
