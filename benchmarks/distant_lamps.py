# SPDX-License-Identifier: GPL-3.0-or-later
"""Error of lamps by nearest directions, on bakes of distant light, by how far away the lamp is.

    python benchmarks/distant_lamps.py                                  spot on a ground, and without
    python benchmarks/distant_lamps.py --mesh stanford-bunny.obj --ground off

A point lamp stands at so many radii of the model from its middle, 40 degrees up, at four sides; the error is the
relative RMS of unit-albedo exit radiance, bounces included, at random receivers, against direct light by rays and
bounced light by path tracing, over the sides that lie outside the hull of the scene. The same lamp at the end, as a
sun, is what each basis loses of a hard light at any distance.
"""

from __future__ import annotations

import argparse
import os
from dataclasses import replace

os.environ.setdefault("OPENBLAS_NUM_THREADS", "2")  # before numpy loads

import numpy as np
from common import drain, print_table
from eigentransport import ground_under, upright
from numpy.typing import NDArray

from prt_addon.baking.recipe import bake, exhaust
from prt_addon.baking.settings import BakeSettings
from prt_addon.lighting.local_lights import LocalLight
from prt_addon.relighting.direct_light import direct_local_light
from prt_addon.relighting.distant_lamps import distant_lamp_radiance
from prt_addon.relighting.lamp_light import unit_lamp
from prt_addon.relighting.nearest_directions import Hull
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.tracing.tracer import Tracer
from prt_addon.transport.path_reference import PointLights, reference_radiance
from prt_addon.transport.receiver_set import ReceiverSet

DISTANCES = (1.2, 1.5, 2.0, 3.0, 5.0, 10.0, 30.0, 1000.0)
SIDES, HEIGHT = 4, np.radians(40.0)
RECEIVERS, PATHS = 200, 512
SETTINGS = BakeSettings(directions=2048, gather_directions=128, spacing=0.0, error_receivers=0, encoder="static",
                        clusters=256, vectors=8)
KINDS = {"harmonics, order 5": {"order": 5}, "order 10": {"order": 10},
         "cubemap 16": {"distant_basis": "cubemap", "cubemap_size": 16}}


def places(middle: NDArray[np.float64], radius: float) -> NDArray[np.float64]:
    """(distances, sides, 3)."""
    azimuth = 0.4 + 2.0 * np.pi * np.arange(SIDES) / SIDES
    towards = np.stack([np.cos(azimuth) * np.cos(HEIGHT), np.sin(azimuth) * np.cos(HEIGHT),
                        np.full(SIDES, np.sin(HEIGHT))], axis=1)
    return middle + radius * np.array(DISTANCES)[:, None, None] * towards


def truth_of(scene: SceneMesh, keys: NDArray[np.int64], lamps: list[LocalLight]) -> NDArray[np.float64]:
    """(lamps, receivers in the order of keys, 3)."""
    tracer = Tracer(scene.points, scene.triangles)
    receivers = ReceiverSet.of_keys(scene, tracer, keys)
    positions = np.array([lamp.position for lamp in lamps])
    bounced = drain(reference_radiance(tracer, scene, receivers, scene.albedo,
                                       lambda directions: np.zeros((len(directions), len(lamps), 3)),
                                       PointLights(positions), PATHS, -1, 1)).mean(axis=0).transpose(1, 0, 2)
    found = np.array([direct_local_light(tracer, receivers, [lamp], 1) for lamp in lamps]) + bounced
    return found[:, np.argsort(receivers.key)]


def measure(mesh: str, ground: bool) -> list[list]:
    """Rows of the table of one scene."""
    model = upright(mesh)
    scene = SceneMesh.assemble([model, ground_under(model)] if ground else [model])
    low, high = model.positions.min(axis=0), model.positions.max(axis=0)
    middle = 0.5 * (low + high)
    radius = float(np.sqrt(np.square(model.positions - middle).sum(axis=1).max()))
    where = places(middle, radius)
    inside = Hull(scene.points).inside(where.reshape(-1, 3)).reshape(where.shape[:2])
    keys = np.sort(np.random.default_rng(3).choice(np.flatnonzero(~scene.loose), RECEIVERS, replace=False))
    # A lamp of 1 W/sr at a distance of one, whatever the distance: numbers stay comparable.
    lamps = [replace(unit_lamp(place), power=unit_lamp(place).power * float(np.square(place - middle).sum()))
             for place in where.reshape(-1, 3)]
    unit = [float(np.square(place - middle).sum()) for place in where.reshape(-1, 3)]
    truth = truth_of(scene, keys, [unit_lamp(place) for place in where.reshape(-1, 3)]) * np.array(unit)[:, None, None]
    rows = [[f"{mesh.split('.')[0]}{', ground' if ground else ''}", distance,
             f"{int((~inside[number]).sum())} of {SIDES}"] for number, distance in enumerate(DISTANCES)]
    for more in KINDS.values():
        baked = exhaust(bake(scene, replace(SETTINGS, **more))).objects
        objects = {o.name: o for o in scene.objects}
        for number, row in enumerate(rows):
            squares = power = 0.0
            for side in np.flatnonzero(~inside[number]):
                lamp = number * SIDES + side
                found = np.concatenate([distant_lamp_radiance(container, [lamps[lamp]])[:, 0][
                    keys[(keys >= objects[name].points.start) & (keys < objects[name].points.stop)]
                    - objects[name].points.start] for name, container in baked.items()])
                squares += float(np.square(found - truth[lamp]).sum())
                power += float(np.square(truth[lamp]).sum())
            row.append(100.0 * np.sqrt(squares / power) if power else "-")
    return rows


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mesh", default="spot.obj")
    parser.add_argument("--ground", choices=("on", "off", "both"), default="both")
    options = parser.parse_args()
    rows = []
    for ground in {"on": (True,), "off": (False,), "both": (False, True)}[options.ground]:
        rows += measure(options.mesh, ground)
    print_table(["scene", "distance / radii", "outside the hull", *(f"{kind} %" for kind in KINDS)], rows)


if __name__ == "__main__":
    main()
