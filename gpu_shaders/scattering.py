# SPDX-License-Identifier: GPL-3.0-or-later
"""The three passes of live subsurface light on the graphics card (relighting/live_scattering.py says what they give).

Links and places stay there; what changes with a lamp is one texture of direct light and one of bounced light.
"""

from __future__ import annotations

import time

import gpu
import numpy as np
from numpy.typing import NDArray

from ..prt_addon.relighting.live_scattering import LiveScattering
from .compute_program import GROUP_SIZE, ComputeProgram
from .render_data import LARGEST_TEXTURE, TEXTURE_WIDTH, texture_height, texture_values
from .subsurface_programs import NODE_TEXELS, program
from .textures import make_texture, read_texture

Texture = gpu.types.GPUTexture


class ScatteringPasses:
    """The lists of one body's bake on the graphics card, and what they are run on."""

    def __init__(self, live: LiveScattering) -> None:
        pyramid, links = live.pyramid, live.links
        self.live, self._start, self._links = live, pyramid.start, links.texels.shape[1]
        self._places, self._rows = int(pyramid.start[1]), len(links.texels)
        places = np.zeros((self._places, 4), np.float32)
        places[:, 0], places[:, 1], places[:, 2] = live.receiver, 1.0, pyramid.area[:self._places]
        self._place_values = make_texture(texture_values(places))
        self._centre_values = make_texture(texture_values(pyramid.centre))
        self._link_values = make_texture(texture_values(links.texels.transpose(1, 0, 2).reshape(-1, 4)))
        leaving = np.zeros((len(live.through), 2, 4), np.float32)
        leaving[:, 0, 0] = -1.0
        leaving[live.receiver[live.used], 0, 0] = np.arange(self._rows)
        leaving[:, 0, 1], leaving[:, 0, 2], leaving[:, 1, :3] = live.row, live.through, live.factor
        self._leaving_values = make_texture(texture_values(leaving.reshape(-1, 4)))
        self._pyramid_values = _room(NODE_TEXELS * len(pyramid.area))
        self._scattered_values = _room(self._rows)

    def run(self, direct: Texture, bounced: Texture | None, points: int, rows: int) -> Texture:
        """What is to be added to the exit radiance, for direct light (points * rows texels) and the bounced light of
        the diffuse row (points texels)."""
        share, other = (0.0, direct) if bounced is None else (1.0, bounced)
        _dispatch(program("irradiance"), self._places, self._pyramid_values, places=self._places, rows=rows,
                  bounced_share=share, place_values=self._place_values, direct_values=direct, bounced_values=other)
        for level in range(1, len(self._start) - 1):
            count = int(self._start[level] - self._start[level - 1]) // 4
            _dispatch(program("reduce"), count, self._pyramid_values, centre_values=self._centre_values,
                      level_range=(int(self._start[level - 1]), int(self._start[level]), count, level - 1))
        _dispatch(program("gather"), self._rows, self._scattered_values, places=self._rows, links=self._links,
                  link_values=self._link_values, pyramid_values=self._pyramid_values)
        shaded = _room(points * rows)
        _dispatch(program("shade"), points * rows, shaded, points=points, rows=rows, bounced_share=share,
                  direct_values=direct, bounced_values=other, scattered_values=self._scattered_values,
                  leaving_values=self._leaving_values)
        return shaded

    def seconds(self, points: int, rows: int) -> float:
        """How long a run takes, the end of it waited for; the second of two, as the first compiles."""
        direct = make_texture(np.zeros((texture_height(points * rows), TEXTURE_WIDTH, 4), np.float32))
        for _ in range(2):
            started = time.perf_counter()
            read_texture(self.run(direct, None, points, rows))
            taken = time.perf_counter() - started
        return taken


def fits(live: LiveScattering) -> bool:
    """Whether the links fit a texture."""
    return live.links.texels[..., 0].size <= TEXTURE_WIDTH * LARGEST_TEXTURE


def bounced_texture(bounced: NDArray[np.float32]) -> Texture:
    """Bounced light (points, 3)."""
    return make_texture(texture_values(bounced))


def _room(texels: int) -> Texture:
    return gpu.types.GPUTexture((TEXTURE_WIDTH, texture_height(texels)), format="RGBA32F")


def _dispatch(chosen: ComputeProgram, count: int, image: Texture,
              **values: Texture | int | float | tuple[int, ...]) -> None:
    """Run a program over `count` invocations. values: its samplers and constants by name."""
    shader = chosen.shader()
    shader.bind()
    for name in chosen.samplers:
        shader.uniform_sampler(name, values[name])
    shader.image(chosen.images[0][0], image)
    for kind, name in chosen.constants:
        (shader.uniform_float if kind == "FLOAT" else shader.uniform_int)(name, values[name])
    gpu.compute.dispatch(shader, TEXTURE_WIDTH // GROUP_SIZE, texture_height(count), 1)
