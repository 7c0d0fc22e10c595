# SPDX-License-Identifier: GPL-3.0-or-later
"""Times the three passes of subsurface light on a graphics card, without Blender: Table 1 of Carr et al. 2003.

    python benchmarks/subsurface_links.py --export DIR        (in the project: shaders, a mesh, the modules that link)
    python DIR/device_subsurface.py [--cases 512x16 1024x16] [--output OUT]

Needs Python 3.12, numpy and moderngl with EGL. Everything else lies beside this script. Prints Markdown and one line of
JSON, checks each result against numpy, and writes the last picture.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import struct
import sys
import time
import zlib
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import moderngl
import numpy as np

FOLDER = Path(__file__).resolve().parent
sys.path.insert(0, str(FOLDER))  # the copied modules beside this script
from prt_addon.relighting.subsurface_texels import link_texels, unpacked_links
from prt_addon.transport.dipole import Medium
from prt_addon.transport.subsurface_links import adaptive_links
from prt_addon.transport.surface_pyramid import SurfacePyramid
from prt_addon.transport.surface_texels import texels_on_mesh

WIDTH, GROUP, LARGEST = 2048, 64, 16384
IOR, PATH, COLOUR = 1.3, (0.02, 0.012, 0.006), (0.85, 0.6, 0.4)  # mean free paths as shares of the diagonal
VERTEX = """#version 430
layout(binding = 0) uniform sampler2D shaded_values;
uniform mat4 transform;
in vec3 position; in vec3 normal;
out vec3 radiance; out float facing;
void main() {
  radiance = texelFetch(shaded_values, ivec2((2 * gl_VertexID + 1) % 2048, (2 * gl_VertexID + 1) / 2048), 0).rgb;
  facing = abs(normal.z);
  gl_Position = transform * vec4(position, 1.0);
}"""
FRAGMENT = """#version 430
in vec3 radiance; in float facing; out vec4 colour;
void main() { colour = vec4(radiance, 1.0 + 1e-6 * facing); }"""


class Device:
    """A context, the compiled passes and the seconds that each took."""

    def __init__(self) -> None:
        self.context = moderngl.create_context(standalone=True, backend="egl", require=430)
        self.programs = {path.stem: self.context.compute_shader(path.read_text()) for path in FOLDER.glob("*.glsl")}

    def texture(self, values: np.ndarray | int) -> moderngl.Texture:
        """Texels (n, 4), or room for so many, row after row."""
        count = values if isinstance(values, int) else len(values)
        height = max(1, -(-count // WIDTH))
        if height > LARGEST:
            raise ValueError(f"{count} texels do not fit a texture")
        data = None
        if not isinstance(values, int):
            filled = np.zeros((height * WIDTH, 4), np.float32)
            filled[:count] = values
            data = filled.tobytes()
        texture = self.context.texture((WIDTH, height), 4, data, dtype="f4")
        texture.filter = moderngl.NEAREST, moderngl.NEAREST
        return texture

    def run(self, name: str, count: int, samplers: list[moderngl.Texture], image: moderngl.Texture,
            **constants: Any) -> None:
        """One dispatch over `count` invocations."""
        program = self.programs[name]
        for slot, texture in enumerate(samplers):
            texture.use(slot)
        image.bind_to_image(0, read=name.startswith("reduce"), write=True)
        for key, value in constants.items():
            program[key].value = value
        program.run(WIDTH // GROUP, -(-count // WIDTH), 1)
        self.context.memory_barrier()

    def read(self, texture: moderngl.Texture, count: int) -> np.ndarray:
        return np.frombuffer(texture.read(), np.float32).reshape(-1, 4)[:count, :3]

    def seconds(self, work: Any, repeats: int) -> float:
        """Median seconds on the device's own clock."""
        found = []
        for _ in range(repeats):
            query = self.context.query(time=True)
            with query:
                work()
            found.append(query.elapsed * 1e-9)
        return float(np.median(found))


class Linked(NamedTuple):
    """The atlas of a mesh and the texels of its links."""

    side: int
    links: int
    texels: Any
    pyramid: SurfacePyramid
    packed: np.ndarray
    atlas_seconds: float
    link_seconds: float


_PART: list[tuple[SurfacePyramid, int]] = []  # what the processes below were started with


def _part(places: np.ndarray) -> np.ndarray:
    pyramid, links = _PART[-1]
    return link_texels(adaptive_links(pyramid, places, Medium.of_coefficients(*_coefficients(), 1.0), links))


def linked(mesh: dict[str, np.ndarray], side: int, links: int, processes: int) -> Linked:
    """side^2 texels with so many links each, found by several processes. Before any context: they are forked."""
    started = time.perf_counter()
    texels = texels_on_mesh(mesh["positions"], mesh["normals"], mesh["triangles"], side * side)
    pyramid = SurfacePyramid.over_points(texels.points, texels.normals, texels.areas)
    atlas, started = time.perf_counter() - started, time.perf_counter()
    _PART.append((pyramid, links))
    with multiprocessing.get_context("fork").Pool(processes) as pool:
        packed = np.concatenate(pool.map(_part, np.array_split(np.arange(side * side), max(processes * 4, 1)), 1))
    _PART.pop()
    return Linked(side, links, texels, pyramid, packed, atlas, time.perf_counter() - started)


class Body:
    """The lists of one mesh at one size of its atlas, on the device."""

    def __init__(self, device: Device, mesh: dict[str, np.ndarray], found: Linked) -> None:
        self.pyramid, texels, links = found.pyramid, found.texels, found.links
        pyramid, packed = found.pyramid, found.packed
        self.atlas_seconds, self.link_seconds = found.atlas_seconds, found.link_seconds
        self.device, self.links, self.places = device, links, int(pyramid.start[1])
        geometry = np.zeros((self.places, 8), np.float32)
        geometry[:, :3], geometry[:, 3] = texels.points[pyramid.texel], pyramid.area[:self.places]
        geometry[:, 4:7], geometry[:, 7] = texels.normals[pyramid.texel], IOR
        self.geometry = device.texture(geometry.reshape(-1, 4))
        self.linked = unpacked_links(packed)  # as the shaders see them
        self.link_values = device.texture(packed.transpose(1, 0, 2).reshape(-1, 4))
        centres = np.zeros((len(pyramid.area), 4), np.float32)
        centres[:, :3] = pyramid.centre
        self.centres = device.texture(centres)
        self.nodes = {"": device.texture(4 * len(pyramid.area)), "_plain": device.texture(len(pyramid.area))}
        self.scattered, self.kind = device.texture(self.places), ""
        self.vertices = len(mesh["positions"])
        leaving = np.zeros((self.vertices, 2, 4), np.float32)
        leaving[:, 0, 0] = _texel_of_vertex(mesh["triangles"], texels, pyramid, self.vertices)
        leaving[:, 0, 1], leaving[:, 1] = 1.0, 1.0
        leaving = leaving.reshape(-1, 4)
        self.leaving, self.nothing = device.texture(leaving), device.texture(np.zeros((2 * self.vertices, 4)))
        self.shaded = device.texture(2 * self.vertices)

    @property
    def pyramid_values(self) -> moderngl.Texture:
        """Nodes with moments, or with the means alone."""
        return self.nodes[self.kind]

    def irradiance(self, lamp: tuple[float, ...]) -> None:
        self.device.run("lamp" + self.kind, self.places, [self.geometry], self.pyramid_values, places=self.places,
                        lamp=lamp)

    def reduce(self) -> None:
        start = self.pyramid.start
        for level in range(1, self.pyramid.levels):
            count = int(start[level] - start[level - 1]) // 4
            self.device.run("reduce" + self.kind, count, [] if self.kind else [self.centres], self.pyramid_values,
                            level_range=(int(start[level - 1]), int(start[level]), count, level - 1))

    def gather(self, links: int) -> None:
        self.device.run("gather" + self.kind, self.places, [self.link_values, self.pyramid_values], self.scattered,
                        places=self.places, links=links)

    def shade(self) -> None:
        self.device.run("shade", 2 * self.vertices, [self.nothing, self.nothing, self.scattered, self.leaving],
                        self.shaded, points=self.vertices, rows=2, bounced_share=0.0)

    def difference(self) -> float:
        """Largest difference of what the passes found to numpy's sum over the same links, relative to its largest."""
        step = 1 if self.kind else 4
        level0 = self.device.read(self.pyramid_values, step * self.places)[::step]
        means = self.pyramid.means(level0[np.argsort(self.pyramid.texel)])
        some = np.random.default_rng(0).choice(self.places, min(self.places, 20000), replace=False)
        sums = self.linked.of(some).gathered(means, None if self.kind else self.pyramid.moments(means))
        found = self.device.read(self.scattered, self.places)[some]
        return float(np.abs(found - sums).max() / np.abs(sums).max())


def _coefficients() -> tuple[np.ndarray, np.ndarray]:
    """sigma_s' and sigma_a in units of the diagonal, for COLOUR's albedo as it is of a single scattering."""
    extinction = 1.0 / np.array(PATH)
    alpha = 1.0 - (1.0 - np.array(COLOUR)) ** 2
    return extinction * alpha, extinction * (1.0 - alpha)


def _texel_of_vertex(triangles: np.ndarray, texels: Any, pyramid: SurfacePyramid, vertices: int) -> np.ndarray:
    """The place of the texel nearest to each vertex, of those on its triangles."""
    corner = triangles[texels.triangle]
    place = pyramid.place(len(texels.areas))
    best, found = np.full(vertices, -1.0), np.zeros(vertices, np.int64)
    for k in range(3):
        order = np.argsort(texels.weights[:, k])
        share = np.full(vertices, -1.0)
        share[corner[order, k]] = texels.weights[order, k]  # the last, largest, stays
        chosen = np.zeros(vertices, np.int64)
        chosen[corner[order, k]] = place[order]
        better = share > best
        best, found = np.where(better, share, best), np.where(better, chosen, found)
    return found


class Picture:
    """Pass three as the paper has it: the mesh is drawn with what its vertices look up."""

    def __init__(self, device: Device, mesh: dict[str, np.ndarray], size: int = 1024) -> None:
        context, self.size = device.context, size
        program = context.program(vertex_shader=VERTEX, fragment_shader=FRAGMENT)
        positions = mesh["positions"].astype(np.float32)
        self.target = context.framebuffer([context.texture((size, size), 4, dtype="f4")],
                                          context.depth_renderbuffer((size, size)))
        buffer = context.buffer(np.concatenate([positions, mesh["normals"]], axis=1).astype(np.float32).tobytes())
        self.array = context.vertex_array(program, [(buffer, "3f 3f", "position", "normal")],
                                          context.buffer(mesh["triangles"].astype(np.int32).tobytes()))
        middle, reach = 0.5 * (positions.min(axis=0) + positions.max(axis=0)), 0.62 * float(np.ptp(positions, 0).max())
        transform = np.eye(4)
        transform[:3, :3] = np.diag([1.0, 1.0, -1.0]) / reach
        transform[:3, 3] = -middle / reach * [1.0, 1.0, -1.0]
        program["transform"].write(transform.T.astype(np.float32).tobytes())
        context.enable(moderngl.DEPTH_TEST)

    def draw(self, shaded: moderngl.Texture) -> None:
        self.target.use()
        self.target.clear()
        shaded.use(0)
        self.array.render()

    def save(self, path: Path) -> None:
        """An 8 bit PNG, brightest at 1, roughly as a screen shows it."""
        values = np.frombuffer(self.target.read(components=4, dtype="f4"), np.float32).reshape(self.size, self.size, 4)
        values = values[::-1, :, :3]
        grey = np.clip(values / np.quantile(values[values > 0.0], 0.99), 0.0, 1.0) ** (1.0 / 2.2)
        rows = np.concatenate([np.zeros((self.size, 1), np.uint8),
                               (grey * 255.0).astype(np.uint8).reshape(self.size, -1)], axis=1)

        def chunk(kind: bytes, data: bytes) -> bytes:
            return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

        header = struct.pack(">IIBBBBB", self.size, self.size, 8, 2, 0, 0, 0)
        path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows.tobytes()))
                         + chunk(b"IEND", b""))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="*", default=("512x16", "512x64", "1024x16", "1024x32"), help="SIDExLINKS")
    parser.add_argument("--repeats", type=int, default=30)
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--output", type=Path, default=Path(os.environ.get("OUT", FOLDER)))
    arguments = parser.parse_args()
    started = time.perf_counter()
    with np.load(FOLDER / "mesh.npz") as stored:
        mesh = dict(stored)
    found = [linked(mesh, *map(int, case.split("x")), arguments.processes) for case in arguments.cases]
    device = Device()
    info = device.context.info
    print(f"{info['GL_RENDERER']}, OpenGL {info['GL_VERSION']}; {len(mesh['triangles'])} triangles, "
          f"{len(mesh['positions'])} vertices; {arguments.processes} processes link; "
          f"milliseconds, median of {arguments.repeats}", flush=True)
    print("| atlas | kind | links | atlas s | link s (CPU) | irradiance | pyramid | gather | shade | draw | frame | "
          "frames/s | off |\n|" + " --- |" * 13, flush=True)
    picture, results = Picture(device, mesh), []
    arguments.output.mkdir(parents=True, exist_ok=True)
    for case in found:
        body = Body(device, mesh, case)
        for body.kind in ("_plain", ""):
            results.append(timed(device, body, picture, case.side, case.links, arguments.repeats))
            picture.save(arguments.output / f"device_subsurface_{case.side}_{case.links}{body.kind}.png")
    print(json.dumps({"renderer": info["GL_RENDERER"], "seconds": time.perf_counter() - started, "rows": results}))


def timed(device: Device, body: Body, picture: Picture, side: int, links: int, repeats: int) -> dict[str, Any]:
    """Milliseconds of every pass, and of frames with a lamp that goes round."""
    angle, lamp = 0.0, (0.3, 0.8, -1.2, 1.0)
    for _ in range(20):  # compiles, and wakes the card
        body.irradiance(lamp)
        body.reduce()
        body.gather(links)
        body.shade()
        picture.draw(body.shaded)
    device.context.finish()
    parts = {"irradiance": lambda: body.irradiance(lamp), "pyramid": body.reduce, "gather": lambda: body.gather(links),
             "shade": body.shade, "draw": lambda: picture.draw(body.shaded)}
    row = {name: 1e3 * device.seconds(work, repeats) for name, work in parts.items()}
    difference = body.difference()
    device.context.finish()
    started = time.perf_counter()
    for _ in range(repeats):
        angle += 0.1
        body.irradiance((1.2 * np.sin(angle), 0.8, -1.2 * np.cos(angle), 1.0))
        body.reduce()
        body.gather(links)
        body.shade()
        picture.draw(body.shaded)
    device.context.finish()
    frame = (time.perf_counter() - started) / repeats
    body.irradiance(lamp)
    for work in (body.reduce, lambda: body.gather(links), body.shade, lambda: picture.draw(body.shaded)):
        work()
    row |= {"side": side, "kind": "paper" if body.kind else "moments", "links": links, "frame": 1e3 * frame,
            "off": difference, "atlas_seconds": body.atlas_seconds, "link_seconds": body.link_seconds}
    print(f"| {side}^2 | {row['kind']} | {links} | {body.atlas_seconds:.1f} | {body.link_seconds:.1f} | "
          + " | ".join(f"{row[name]:.4f}" for name in parts)
          + f" | {row['frame']:.3f} | {1.0 / frame:.0f} | {difference:.1e} |", flush=True)
    return row


if __name__ == "__main__":
    main()
