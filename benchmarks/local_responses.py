# SPDX-License-Identifier: GPL-3.0-or-later
"""Responses to local lights: the source of the first bounce at lights near and far, and seconds for a whole cloud.

    python benchmarks/local_responses.py [--lights 1024] [--spacing 0.02] [--methods]

Methods (--methods): the field sampled at corners; the closed-form flux of near triangles (`NearTriangles`); photons
splatted to corners. Each as the source of one bounce in a closed room of 2 m with a block; errors are relative RMS over
64 receivers against brute force (rays from the receivers, the light sampled at each hit).
"""

from __future__ import annotations

import argparse
import os
import sys
import time

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the bake's process; before numpy loads

import numpy as np
from common import ROOT, drain, print_table
from numpy.typing import NDArray

sys.path.insert(0, str(ROOT))

from prt_addon.basis.directions import quadrature, spherical_fibonacci
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.tracing.tracer import Tracer
from prt_addon.transport.gather import gather_operator
from prt_addon.transport.local_lights import LightSolver, unit_light_direct
from prt_addon.transport.near_light import NearTriangles
from tests.core.shapes import box
from tests.core.test_local_responses import Room, first_bounce


def scene(spacing: float) -> SceneMesh:
    """The room."""
    return SceneMesh.assemble([box("room", (-1, -1, -1), (1, 1, 1), inward=True),
                               box("block", (-0.6, -0.6, -0.9), (0.0, 0.0, -0.3))], spacing)


def splatted(room: Room, light: NDArray[np.float64], photons: int) -> NDArray[np.float32]:
    """The source field by photons: each leaves its power at the corners of the triangle that it meets."""
    directions = spherical_fibonacci(photons).astype(np.float32)
    hits = room.tracer.nearest(np.repeat(room.tracer.to_tracing_space(light[None]), photons, axis=0), directions)
    met = np.flatnonzero(hits.triangle >= 0)
    row = np.full(2 * len(room.scene.points), -1)
    row[room.receivers.key] = np.arange(len(room.receivers))
    side = np.where(hits.front[met], 0, len(room.scene.points))[:, None]
    rows = row[room.scene.triangles[hits.triangle[met]] + side]
    weights = np.stack([1.0 - hits.u - hits.v, hits.u, hits.v], axis=1)[met] * (4.0 * np.pi / photons)
    power = np.bincount(rows[rows >= 0], weights[rows >= 0], len(room.receivers))
    return (power / (np.pi * np.maximum(room.area, 1e-30))).astype(np.float32)[:, None]


def methods() -> None:
    """Error of the first bounce by the source's method."""
    room = Room(scene(0.03), 0.5, 2048)
    count = len(room.scene.points)
    clear = (np.abs(room.scene.points) < 0.95).sum(axis=1) >= 2
    front = np.flatnonzero((room.receivers.key < count) & clear[room.receivers.key % count])
    chosen = np.random.default_rng(3).choice(front, 64, replace=False)
    places = room.tracer.diagonal * room.receivers.origins[chosen].astype(float) + room.tracer._centre
    near = NearTriangles(room.tracer, room.scene, room.receivers)
    rows = []
    for height in (1.0, 0.3, 0.1, 0.03, 0.01, 0.001):
        light = np.array([0.43, 0.51, -1.0 + height])
        exact = np.array([first_bounce(room, place, normal, light, 40_000, 7) for place, normal in zip(
            places, room.receivers.normals[chosen], strict=True)])
        fields = {}
        fields["corners"] = timed(lambda light=light: drain(
            unit_light_direct(room.tracer, room.receivers, light[None])))
        sampled = fields["corners"][1]

        def conserved(light: NDArray = light, sampled: NDArray = sampled) -> NDArray:
            field = sampled.copy()
            near.replace(field, near.near(light[None])[0], light[None], 1)
            return field

        fields["closed form added"] = timed(conserved)
        for photons in (4096, 65536):
            fields[f"{photons} photons"] = timed(lambda light=light, n=photons: splatted(room, light, n))
        for name, (seconds, field) in fields.items():
            found = (room.gathered.matrix @ (0.5 * field))[chosen, 0]
            error = np.sqrt(np.mean((found - exact) ** 2) / np.mean(exact ** 2))
            flux = float(np.sum(room.area * field[:, 0])) / 4.0
            rows.append([height, name, 1e3 * seconds, 100 * error, 100 * (found.mean() / exact.mean() - 1), flux])
    print(f"{len(room.receivers)} receivers, edges {near._longest.max():.3f} m")
    print_table(["height m", "source", "ms", "relative RMS %", "mean error %", "flux / emitted"], rows)


def timed(work) -> tuple[float, NDArray]:  # noqa: ANN001
    """Seconds and result."""
    started = time.perf_counter()
    result = work()
    return time.perf_counter() - started, result


def whole_cloud(lights: int, spacing: float) -> None:
    """Seconds of a cloud, by part."""
    made = scene(spacing)
    tracer = Tracer(made.points, made.triangles)
    keys = np.flatnonzero(~made.loose)
    seconds, gathered = timed(lambda: drain(gather_operator(tracer, made, keys, *quadrature(128, 4))))
    positions = np.random.default_rng(2).uniform(-0.9, 0.9, (lights, 3))
    receivers, near = gathered.receivers, NearTriangles(tracer, made, gathered.receivers)
    rows = [["gather operator", seconds]]
    part = positions[:64]
    scale = lights / len(part)
    direct_seconds, direct = timed(lambda: drain(unit_light_direct(tracer, receivers, part)))
    rows.append(["direct field (of 64 lights, scaled)", scale * direct_seconds])
    albedo = np.full((len(receivers), 1), 0.5, np.float32)
    for bounces in (2, -1):
        solver = LightSolver(tracer, made, gathered, albedo, 1e-3, bounces)
        rows.append([f"near triangles, bounces {bounces} (of 64, scaled): flux", scale * timed(
            lambda solver=solver: solver._conserve_flux(near, direct.copy(), part))[0]])
        rows.append([f"bounces {bounces} (of 64, scaled)",
                     scale * timed(lambda solver=solver: drain(solver._bounced(direct)))[0]])
    print(f"{len(receivers)} receivers, {lights} lights, {gathered.matrix.nnz / 1e6:.1f} M entries, 1 channel")
    print_table(["part", "seconds"], rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lights", type=int, default=1024)
    parser.add_argument("--spacing", type=float, default=0.01)
    parser.add_argument("--methods", action="store_true")
    arguments = parser.parse_args()
    if arguments.methods:
        methods()
    else:
        whole_cloud(arguments.lights, arguments.spacing)


if __name__ == "__main__":
    main()
