# SPDX-License-Identifier: GPL-3.0-or-later
"""GPU objects of baked objects. Needs an active GPU context; main thread only.

GPUTexture and GPUVertBuf can't be updated, so the constants' texture is made anew per light change and dropped at once,
while the encoding, the mesh and the texture of exit radiances live as long as the data's signature does.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from dataclasses import dataclass

import gpu
import numpy as np
from mathutils import Matrix
from numpy.typing import ArrayLike, NDArray

from ..prt_addon.errors import PRTError
from ..prt_addon.relighting.exit_radiance import baked_constants
from ..prt_addon.relighting.live_scattering import LiveScattering
from ..prt_addon.scene.surface_textures import SurfaceTextures, TextureUse
from . import image_textures, programs, texel_programs
from .compute_program import GROUP_SIZE
from .image_textures import TexturedVertices, textured_vertices
from .render_data import (
    DrawItem,
    LampScattering,
    RenderData,
    clip_transform,
    constant_texels,
    heat_colours,
    light_signature,
    make_render_data,
    matching_light,
    plain_surface,
    texture_values,
    viewer_of,
)
from .scattering import ScatteringPasses, bounced_texture, fits
from .textures import make_texture, read_texture

STALE_DIMMING = 0.3  # factor on a stale object's radiance


class ObjectDrawing:
    """The mesh, encoding and exit radiances of one baked object."""

    def __init__(self, data: RenderData) -> None:
        self.data = data
        self._vertices = _make_vertices(data)
        self._batch = _make_batch(self._vertices, data.triangles)
        self._textured: list[_TexturedPart] = []
        self._textures_key: Hashable = None
        self._encoding = make_texture(data.encoding)
        self._atlas = None if data.atlas is None else make_texture(data.atlas)
        self._exit = gpu.types.GPUTexture(data.exit_size, format="RGBA32F")
        self._colours: gpu.types.GPUTexture | None = None
        self._plain_batch: gpu.types.GPUBatch | None = None  # for colours, one vertex per point
        self._direct: gpu.types.GPUTexture | None = None
        self._direct_values: NDArray[np.float32] | None = None
        self._scattering: LampScattering | None = None
        self._passes: ScatteringPasses | None = None

    def relight(self, constants: NDArray[np.float32]) -> None:
        """Compute every point's exit radiance from per-cluster constants (clusters, vectors + 1, rows, 3)."""
        data = self.data
        expected = (data.clusters, data.vectors + 1, data.rows, 3)
        if constants.shape != expected:
            raise ValueError(f"constants have shape {constants.shape}, the drawn data needs {expected}")
        self._colours = None
        constant_values = make_texture(constant_texels(constants, data.cluster_vectors))  # must outlive the dispatch
        program = programs.exit_radiance()
        program.bind()
        program.uniform_sampler("encoding_values", self._encoding)
        program.uniform_sampler("constant_values", constant_values)
        program.image("exit_values", self._exit)
        program.uniform_int("points", data.points)
        program.uniform_int("rows", data.rows)
        program.uniform_int("vectors", data.vectors)
        width, height = data.exit_size
        gpu.compute.dispatch(program, width // GROUP_SIZE, height, 1)

    def show_colours(self, colours: NDArray[np.float32]) -> None:
        """Draw (points, 3) colours in place of computed radiances."""
        self._colours = make_texture(texture_values(colours))
        if self.data.functions and self._plain_batch is None:
            plain = plain_surface(self.data)
            self._plain_batch = _make_batch(_make_vertices(plain), plain.triangles)

    def add_direct(self, values: NDArray[np.float32] | None, scattering: LampScattering | None = None) -> None:
        """Direct light (points, rows, 3), for unit albedo in row 0, to add from now on; None for none."""
        if values is self._direct_values and scattering is self._scattering:
            return
        expected = (self.data.points, self.data.rows, 3)
        if values is not None and values.shape != expected:
            raise ValueError(f"direct light has shape {values.shape}, the drawn data needs {expected}")
        self._direct_values, self._scattering = values, scattering
        self._direct = None if values is None else make_texture(texture_values(values.reshape(-1, 3)))
        if self._direct is not None and scattering is not None:
            self._scatter(scattering)

    def _scatter(self, scattering: LampScattering) -> None:
        """Take the direct light through the body here, or find out once how long that would take."""
        live, data = scattering.live, self.data
        if scattering.on_card:
            if self._passes is None or self._passes.live is not live:
                self._passes = ScatteringPasses(live)
            bounced = None if scattering.bounced is None else bounced_texture(scattering.bounced)
            self._direct = self._passes.run(self._direct, bounced, data.points, data.rows)
        elif live.card_seconds is None:
            live.card_seconds = self._card_seconds(live)
            if not live.prefers_card:
                self._passes = None  # the processor will go on

    def _card_seconds(self, live: LiveScattering) -> float:
        """How long the passes take here; infinite where the links fit no texture or the driver can't run them."""
        if not fits(live):
            return float("inf")
        try:
            self._passes = ScatteringPasses(live)
            return self._passes.seconds(self.data.points, self.data.rows)
        except (PRTError, RuntimeError, SystemError, ValueError):  # the processor always can
            return float("inf")

    def show_textures(self, textures: SurfaceTextures | None) -> None:
        """Take the albedo from images from now on; None for that of the points."""
        key = None if textures is None else textures.key
        if key == self._textures_key:
            return
        self._textures_key, self._textured = key, []
        if textures is None:
            return
        if len(textures.use) != len(self.data.triangles):
            raise ValueError(f"textures of {len(textures.use)} triangles do not fit {len(self.data.triangles)}")
        found = textured_vertices(self.data, textures)
        vertices = _make_vertices(self.data, found)
        for number in np.unique(textures.use):
            mine = textures.use == number
            plain = _make_batch(self._vertices, self.data.triangles[mine])
            self._textured.append(_TexturedPart(plain) if number < 0 else _TexturedPart(
                plain, textures.uses[number], _make_batch(vertices, found.triangles[mine])))

    def exit_radiances(self) -> NDArray[np.float32]:
        """The exit radiances on the GPU for unit albedo, (points, rows, 3). Waits for the GPU: for tests and export."""
        count = self.data.points * self.data.rows
        return read_texture(self._exit).reshape(-1, 4)[:count, :3].reshape(self.data.points, self.data.rows, 3)

    def draw(self, transform: NDArray[np.floating], exposure: float = 1.0, use_albedo: bool = True) -> None:
        """Draw into the active framebuffer; transform (4, 4) from baked world positions to clip space.

        exposure: factor on the colours. use_albedo: multiply by the surface's albedo; without, unit albedo.
        """
        if self._colours is not None:
            self._draw_batch(self._plain_batch or self._batch, transform, exposure, use_albedo)
            return
        for part in self._textured or (_TexturedPart(self._batch),):
            image = image_textures.texture_of(part.use) if part.use is not None and use_albedo else None
            if image is None:
                self._draw_batch(part.plain, transform, exposure, use_albedo)
            else:
                self._draw_batch(part.batch, transform, exposure, use_albedo, image)

    def _draw_batch(self, batch: gpu.types.GPUBatch, transform: NDArray[np.floating], exposure: float, use_albedo: bool,
                    image: tuple[gpu.types.GPUTexture, tuple[float, ...]] | None = None) -> None:
        """Draw some of the triangles. image: of their albedo, see `image_textures`."""
        depends_on_view = bool(self.data.functions) and self._colours is None
        textured = image is not None
        functions = self.data.functions if depends_on_view else ()
        if self._atlas is not None:
            program = texel_programs.texel_surface(functions, textured)
        else:
            program = programs.view_surface(functions, textured) if depends_on_view else programs.surface(textured)
        program.bind()
        if self._atlas is not None:
            program.uniform_sampler("atlas_points", self._atlas)
        exit_values = self._exit if self._colours is None else self._colours
        direct = self._direct if self._colours is None else None
        program.uniform_sampler("exit_values", exit_values)
        program.uniform_sampler("direct_values", exit_values if direct is None else direct)
        program.uniform_float("direct_share", 0.0 if direct is None else 1.0)
        program.uniform_float("transform", Matrix(transform.tolist()))
        if depends_on_view and programs.sees_viewer(self.data.functions):
            program.uniform_float("viewer", viewer_of(transform).tolist())
        program.uniform_float("exposure", exposure)
        program.uniform_float("albedo_share", 1.0 if use_albedo else 0.0)
        if image is not None:
            program.uniform_sampler("albedo_image", image[0])
            program.uniform_float("texture_factor", image[1])
        batch.draw(program)


@dataclass(frozen=True, eq=False)
class _TexturedPart:
    """Triangles of one texture, and the batch that draws them with the points' albedo; without use they have none."""

    plain: gpu.types.GPUBatch
    use: TextureUse | None = None
    batch: gpu.types.GPUBatch | None = None


def _make_vertices(data: RenderData, textured: TexturedVertices | None = None) -> gpu.types.GPUVertBuf:
    """The vertices with their albedo or places in textures, and their frames where the view counts. gl_VertexID is the
    point's number where neither is."""
    attributes = {"position": data.positions, "albedo": data.albedo}
    if data.atlas is not None:
        attributes["place_in_atlas"] = data.atlas_places
        if programs.sees_viewer(data.functions):
            attributes |= {"normal": data.normals, "tangent": data.tangents}
    elif data.functions:
        numbers = np.stack([data.receivers, data.turns], axis=1).astype(np.float32)  # exact up to 2^24 points
        attributes |= {"normal": data.normals, "tangent": data.tangents, "receiver_and_turn": numbers}
    if textured is not None:
        del attributes["albedo"]
        attributes = {name: np.ascontiguousarray(values[textured.vertices]) for name, values in attributes.items()}
        attributes["place"] = textured.places
        if not data.functions and data.atlas is None:
            attributes["receiver"] = textured.vertices.astype(np.float32)[:, None]
    layout = gpu.types.GPUVertFormat()
    for name, values in attributes.items():
        layout.attr_add(id=name, comp_type="F32", len=values.shape[1], fetch_mode="FLOAT")
    vertices = gpu.types.GPUVertBuf(layout, len(attributes["position"]))
    for name, values in attributes.items():
        vertices.attr_fill(name, values)
    return vertices


def _make_batch(vertices: gpu.types.GPUVertBuf, triangles: NDArray[np.int32]) -> gpu.types.GPUBatch:
    """Triangles (t, 3) of vertices as an indexed batch."""
    elements = gpu.types.GPUIndexBuf(type="TRIS", seq=np.ascontiguousarray(triangles, np.int32))
    return gpu.types.GPUBatch(type="TRIS", buf=vertices, elem=elements)


class DrawingCache:
    """The drawings of a changing list of objects: built, relit and dropped only when they have to be."""

    def __init__(self) -> None:
        self._drawings: dict[Hashable, ObjectDrawing] = {}
        self._lights: dict[Hashable, Hashable] = {}

    def __len__(self) -> int:
        return len(self._drawings)

    def draw(self, items: Iterable[DrawItem], view_projection: ArrayLike) -> None:
        """Draw the items into the active framebuffer with the depth test on; leaves the GPU state as it was.

        Raises BadScene when a light or a bake's size does not fit.
        """
        depth_test, depth_mask = gpu.state.depth_test_get(), gpu.state.depth_mask_get()
        blend = gpu.state.blend_get()
        gpu.state.depth_test_set("LESS_EQUAL")
        gpu.state.depth_mask_set(True)
        gpu.state.blend_set("NONE")
        gpu.state.face_culling_set("NONE")
        try:
            for item in items:
                factor = item.exposure * (STALE_DIMMING if item.stale else 1.0)
                drawing = self._prepared(item)
                drawing.draw(clip_transform(view_projection, item.matrix), factor, item.is_lit)
        finally:
            gpu.state.depth_test_set(depth_test)
            gpu.state.depth_mask_set(depth_mask)
            gpu.state.blend_set(blend)

    def _prepared(self, item: DrawItem) -> ObjectDrawing:
        """The item's drawing, built if its key is new and relit if its light is."""
        drawing = self._drawings.get(item.key)
        if drawing is None:
            drawing = self._drawings[item.key] = ObjectDrawing(make_render_data(item.baked))
            self._lights.pop(item.key, None)
        light = light_signature(item)
        if self._lights.get(item.key) != light:
            if item.is_lit:
                coefficients = matching_light(item.light, drawing.data.columns)
                drawing.relight(baked_constants(item.baked, coefficients))
            else:
                drawing.show_colours(heat_colours(item.heat) if item.colours is None else item.colours.values)
            self._lights[item.key] = light
        drawing.add_direct(item.direct, item.scattering)
        drawing.show_textures(item.textures)
        return drawing

    def keep_only(self, keys: set[Hashable]) -> None:
        """Drop the drawings of objects that are no longer shown."""
        for key in self._drawings.keys() - keys:
            del self._drawings[key]
            self._lights.pop(key, None)

    def clear(self) -> None:
        """Drop every GPU object."""
        self._drawings.clear()
        self._lights.clear()
