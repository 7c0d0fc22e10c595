# SPDX-License-Identifier: GPL-3.0-or-later
"""Stiff and extreme cases of local lights, what each gives and says: no value may be NaN or infinite.

    python benchmarks/local_extremes.py [--docs]

A closed room of 1 m, albedo 0.7 0.5 0.3, compressed: 64 lights asked for, or lit surfaces. Value: mean bounced radiance
over the vertices (unit albedo), divided by the lamp's intensity in W/sr; `direct`: so, of direct light.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from dataclasses import replace

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the bake's process; before numpy loads

import numpy as np
from common import ROOT, markdown_table, write_block
from numpy.typing import NDArray

from prt_addon.baking.recipe import BakeResult, bake, exhaust
from prt_addon.baking.settings import BakeSettings, make_settings
from prt_addon.errors import PRTError
from prt_addon.lighting.light_cloud import box_matrix
from prt_addon.lighting.light_clustering import merge_lights
from prt_addon.lighting.local_lights import LocalLight
from prt_addon.relighting.exit_radiance import cluster_constants, exit_radiance
from prt_addon.relighting.lamp_light import DirectLight, lamps_in
from prt_addon.relighting.scene_light import joined_light
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.tracing.tracer import Tracer
from tests.core.shapes import box, make

UNIT = 4.0 * np.pi  # watts of a Point light of 1 W/sr
SETTINGS = make_settings("standard", {"lighting": "local", "lamp_basis": "cloud", "cloud_lights": "64",
                                      "cloud_emission": "1", "zone_receivers": "300", "gather_directions": "512",
                                      "clusters": "48", "vectors": "10", "error_receivers": "0", "spacing": "0.06",
                                      "threads": "1"})
CENTRE = (0.4, 0.55, 0.5)


def room(parted: bool = False, solid: bool = False) -> SceneMesh:
    """The room; with a wall at x = 0.5; with a solid cube in it."""
    meshes = [box("room", inward=True, albedo=(0.7, 0.5, 0.3))]
    if parted:
        meshes.append(make("wall", [(0.5, 0, 0), (0.5, 1, 0), (0.5, 1, 1), (0.5, 0, 1)], [(0, 1, 2), (0, 2, 3)],
                           albedo=(0.6, 0.6, 0.6), target=False))
    if solid:
        meshes.append(box("cube", (0.6, 0.2, 0.1), (0.9, 0.5, 0.4), albedo=(0.6, 0.6, 0.6), target=False))
    return SceneMesh.assemble(meshes, 0.06, np.array([CENTRE, (0.8, 0.5, 0.7)]))


def lamp(position: tuple[float, ...], watts: float = UNIT, name: str = "lamp") -> LocalLight:
    matrix = np.eye(4)
    matrix[:3, 3] = position
    return LocalLight(name, "point", matrix, np.full(3, watts), key=name)


class Bake:
    """A finished bake and what lamps do in it."""

    def __init__(self, scene: SceneMesh, settings: BakeSettings = SETTINGS, regions: NDArray | None = None) -> None:
        result: BakeResult = exhaust(bake(scene, settings, regions=regions))
        self.baked, self.facts = result.objects["room"], result.report["local"]
        self.tracer = Tracer(scene.points, scene.triangles, 1)

    def row(self, case: str, *lamps: LocalLight) -> list[object]:
        """Case, bounced, direct, finite, what is said."""
        found = lamps_in(self.baked.cloud, self.tracer).step(lamps)
        constants = cluster_constants(self.baked.bases, joined_light(self.baked.lighting_basis, None, found.values),
                                      self.baked.cluster_zone)
        bounced = exit_radiance(self.baked.cluster, self.baked.weights, constants)
        direct = DirectLight(self.tracer, self.baked).of(lamps)
        finite = bool(np.isfinite(bounced).all() and np.isfinite(direct).all())
        said = [f"outside the cloud: {', '.join(found.outside)}"] if found.outside else []
        said += [f"no light of a zone in sight: {', '.join(found.unlit)}"] if found.unlit else []
        size = lamps[0].power[0] / UNIT
        means = (float(part.astype(np.float64).mean()) / size for part in (bounced, direct))
        return [case, *means, "yes" if finite else "NO", "; ".join(said)]


def failing(case: str, scene: SceneMesh, settings: BakeSettings, regions: NDArray) -> list[object]:
    """A bake that is refused, and with what words."""
    try:
        Bake(scene, settings, regions)
    except PRTError as error:
        return [case, "", "", "refused", str(error)]
    return [case, "", "", "baked", ""]


def lamp_rows(settings: BakeSettings) -> Iterator[list[object]]:
    """Lamps in extreme places and of extreme power."""
    plain = Bake(room(), settings)
    yield plain.row("in the open", lamp(CENTRE))
    for watts in (1e-6, 1e9):
        yield plain.row(f"{watts:g} W", lamp(CENTRE, watts))
    yield plain.row("two lamps at one place", lamp(CENTRE), lamp(CENTRE, name="other"))
    yield plain.row("touches a wall", lamp((0.5, 0.5, 0.0)))
    yield plain.row("1e-9 m above it", lamp((0.5, 0.5, 1e-9)))
    yield plain.row("in a corner", lamp((0.0, 0.0, 0.0)))
    yield plain.row("behind the wall, 0.5 m", lamp((0.5, 0.5, -0.5)))
    yield plain.row("far outside, 1e6 m", lamp((1e6, 1e6, 1e6)))
    solid = Bake(room(solid=True), settings)
    yield solid.row("inside a solid body", lamp((0.75, 0.35, 0.25)))
    yield solid.row("touches a body", lamp((0.6, 0.35, 0.25)))
    one = Bake(room(), replace(settings, cloud_lights=1))
    yield one.row("cloud of one light", lamp(CENTRE))
    half = np.array([box_matrix((0.05, 0.05, 0.05), (0.45, 0.95, 0.95))])
    sealed = Bake(room(parted=True), settings, half)
    yield sealed.row("in a sealed room without lights of the cloud", lamp((0.8, 0.5, 0.5)))
    yield sealed.row("in the room beside it", lamp((0.25, 0.5, 0.5)))
    twice = np.concatenate([half, half])
    yield Bake(room(parted=True), settings, twice).row("two regions at one place", lamp((0.25, 0.5, 0.5)))
    thin = np.array([box_matrix((-0.01, 0.0, 0.0), (0.01, 1.0, 1.0))])
    yield failing("no light of the cloud fits", room(), replace(settings, cloud_radius=0.2), thin)


def merging_rows() -> Iterator[list[object]]:
    """w1 and w2 at their ends: lights kept and the same lamp's light."""
    for distance, response in ((0.5, 0.05), (0.0, 0.05), (0.5, 0.0), (1e6, 0.05), (0.5, 1e6), (1e6, 1e6)):
        made = Bake(room(), replace(SETTINGS, merge_distance=distance, merge_response=response))
        _, bounced, _, finite, said = made.row("", lamp(CENTRE))
        yield [f"{distance:g}", f"{response:g}", made.facts["lights"], float(np.mean(made.facts["merged"])), bounced,
               finite, said]
    generator = np.random.default_rng(1)
    positions, responses = generator.uniform(size=(50, 3)), generator.uniform(size=(80, 50, 3)).astype(np.float32)
    for w1, w2 in ((0.0, 0.0), (1e300, 0.0), (0.0, 1e300), (1e300, 1e300)):
        kept = int(merge_lights(positions, responses, None, w1, w2).max()) + 1
        yield [f"w1 = {w1:g}", f"w2 = {w2:g}", 50, kept, "", "", "eq. 9 alone, no walls"]


def main() -> None:
    """Parse the command line and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--docs", action="store_true")
    arguments = parser.parse_args()
    both = zip(lamp_rows(SETTINGS), lamp_rows(replace(SETTINGS, lamp_basis="surfaces")), strict=True)
    lamps = [[case, direct, bounced, finite, said, *other[1:2], *other[3:]]
             for (case, bounced, direct, finite, said), other in both]
    header = ["lamp", "direct", "cloud: bounced", "finite", "what is said", "surfaces: bounced", "finite", "said"]
    tables = {"extremes": markdown_table(header, lamps),
              "extreme merging": markdown_table(["merge_distance", "merge_response", "lights", "kept, mean", "bounced",
                                                 "finite", ""], list(merging_rows()))}
    for name, table in tables.items():
        print(f"\n{name}\n{table}")
        if arguments.docs:
            write_block(ROOT / "docs" / "local_lights.md", f"local {name}", table)


if __name__ == "__main__":
    main()
