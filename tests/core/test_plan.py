# SPDX-License-Identifier: GPL-3.0-or-later
"""Forecasts of a bake against what it takes: memory in a process of its own, bytes stored, bytes on disk."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from prt_addon.baking import memory
from prt_addon.baking.plan import PROCESS_BYTES, make_plan
from prt_addon.baking.recipe import bake, exhaust, transport_settings
from prt_addon.baking.settings import make_settings
from prt_addon.errors import BadScene
from prt_addon.reporting.stages import available_bytes
from prt_addon.scene.scene_mesh import SceneMesh
from prt_addon.scene.surface_material import SurfaceMaterial
from tests.core.shapes import plane, sphere

ROOT = Path(__file__).parents[2]
QUICK = {"spacing": "0", "error_receivers": "0", "threads": "1", "directions": "128", "gather_directions": "64"}


def still_life(kind, subdivisions=4):
    """A ball over a floor: grey, or the ball of gold."""
    ball, floor = sphere(centre=(0, 0, 0.9), radius=0.8, subdivisions=subdivisions), plane(size=4.0, cells=20)
    if kind == "metal":
        gold = SurfaceMaterial(metallic=1.0, roughness=0.4, base_colour=(0.9, 0.7, 0.3))
        ball = replace(ball, corner_albedo=np.zeros_like(ball.corner_albedo), materials=(gold,),
                       material_index=np.zeros(len(ball.triangles), np.int32))
    return SceneMesh.assemble([floor, ball])


CHILD = """
import json, sys
from prt_addon.reporting.stages import peak_bytes
from tests.core.test_plan import QUICK, bake, exhaust, make_plan, make_settings, still_life, transport_settings
kind, preset, subdivisions, *more = sys.argv[1:]
scene = still_life(kind, int(subdivisions))
settings = make_settings(preset, {**QUICK, "encoder": "static", **dict(item.split("=") for item in more)})
before = peak_bytes()  # not getrusage: there a child begins with the peak of the process that started it
peak = max(stage["peak_bytes"] for stage in exhaust(bake(scene, settings)).report["stages"])
plan = make_plan(scene, transport_settings(settings), None)
print(json.dumps([before, peak, plan.peak_bytes, plan.least_bytes]))
"""
LAMPS = ("lighting=local", "lamp_basis=cloud", "cloud_emission=2", "glossy_rows=4", "cloud_lights=48", "vectors=4")


@pytest.mark.skipif(sys.platform != "linux", reason="other systems count memory otherwise")
@pytest.mark.parametrize(("kind", "preset", "subdivisions", "more"), [
    ("grey", "standard", 5, ()), ("metal", "high", 4, ()), ("grey", "standard", 5, LAMPS),
    ("metal", "draft", 4, LAMPS),
    ("metal", "draft", 4, tuple(item for item in LAMPS if "basis" not in item))])
def test_memory_is_about_as_foretold(kind, preset, subdivisions, more):
    """Lamps of spots on metal: rows x columns x channels of highlights are most of it."""
    done = subprocess.run([sys.executable, "-c", CHILD, kind, preset, str(subdivisions), *more], cwd=ROOT, check=True,
                          capture_output=True, text=True, timeout=100)
    before, peak, foretold, least = json.loads(done.stdout)
    assert least < peak < foretold < 2.0 * (peak - before + PROCESS_BYTES)


def test_stored_bytes_are_about_as_foretold():
    scene, settings = still_life("metal"), make_settings("draft", QUICK)
    plan = make_plan(scene, settings, None)
    result = exhaust(bake(scene, settings))
    stored = sum(getattr(o, name).nbytes for o in result.objects.values()
                 for name in ("bases", "weights", "cluster", "albedo"))
    assert stored < plan.stored_bytes < 3.0 * stored


def test_links_of_translucent_bodies_count_where_lamps_are_baked():
    wax = SurfaceMaterial(subsurface_weight=1.0, subsurface_radius=(0.1, 0.1, 0.1), base_colour=(0.8, 0.6, 0.4))
    ball = sphere(centre=(0, 0, 0.9), radius=0.8, subdivisions=3)
    scene = SceneMesh.assemble([plane(size=4.0, cells=4), replace(
        ball, materials=(wax,), material_index=np.zeros(len(ball.triangles), np.int32))])
    for lighting, expected in (("environment", 0), ("environment,local", 16 * 65 * len(ball.positions))):
        without, with_links = (make_plan(scene, make_settings("draft", {**QUICK, "lighting": lighting, **more}), None)
                               for more in ({}, {"subsurface_links": "64"}))
        assert with_links.stored_bytes - without.stored_bytes == expected


def test_links_count_where_lamps_are_baked_and_are_left_out_else():
    wax = SurfaceMaterial(name="Wax", subsurface_weight=1.0, subsurface_radius=(0.3, 0.2, 0.1), specular_level=0.0)
    ball = sphere(radius=0.8, subdivisions=3)
    ball = replace(ball, materials=(wax,), material_index=np.zeros(len(ball.triangles), np.int32))
    scene = SceneMesh.assemble([ball])
    for lighting in ("local", "environment,local", "environment"):
        none, some = (make_plan(scene, transport_settings(make_settings("draft", {
            **QUICK, "lighting": lighting, "subsurface_links": links})), None) for links in ("0", "64"))
        stored = 65 * 16 * none.receivers if "local" in lighting else 0
        assert some.stored_bytes - none.stored_bytes == stored
        told = [(item.what, item.why) for item in some.needs.left_out if "Wax" in item.what]
        assert told == ([] if stored else [("links for lamps through material Wax", "lighting is environment alone")])


def test_local_lights_count():
    """As columns in what is stored, as responses on disk, and in memory; merging makes them fewer."""
    scene = still_life("grey")
    distant, local, both, all_kept = (make_plan(scene, make_settings("standard", {**QUICK, **more}), None) for more in (
        {}, {"lighting": "local", "lamp_basis": "cloud"}, {"lighting": "environment,local", "lamp_basis": "cloud"},
        {"lighting": "environment,local", "lamp_basis": "cloud", "merge_response": "0"}))
    assert distant.stored_bytes < both.stored_bytes < all_kept.stored_bytes and local.stored_bytes < both.stored_bytes
    responses = 4 * both.receivers * 216 * both.needs.channels
    assert both.disk_bytes > distant.disk_bytes + responses and both.peak_bytes > distant.peak_bytes
    directed = make_plan(scene, make_settings("standard", {
        **QUICK, "lighting": "local", "lamp_basis": "cloud", "cloud_emission": "3"}), None)
    assert directed.disk_bytes > 8 * responses
    surfaces = make_plan(scene, make_settings("standard", {**QUICK, "lighting": "local"}), None)
    assert surfaces.disk_bytes > distant.disk_bytes + 4 * surfaces.receivers * 2048 * surfaces.needs.channels
    assert surfaces.stored_bytes > distant.stored_bytes


def test_a_bake_that_can_not_fit_is_refused_with_a_remedy(monkeypatch):
    """Much more than there is: refused before the first ray; somewhat more: a warning, in the report, too."""
    scene = still_life("metal", 2)
    settings = make_settings("draft", {**QUICK, "lighting": "local", "lamp_basis": "cloud", "cloud_emission": "2",
                                       "cloud_lights": "8"})
    plan = make_plan(scene, transport_settings(settings), None)
    assert plan.least_bytes < plan.peak_bytes
    monkeypatch.setattr(memory, "available_bytes", lambda: plan.least_bytes - 1)
    with pytest.raises(BadScene, match=r"at least about .* MB are free\. Choose fewer lights .*glossy_rows"):
        next(bake(scene, settings))
    monkeypatch.setattr(memory, "available_bytes", lambda: plan.peak_bytes - 1)
    assert any("may need" in line for line in exhaust(bake(scene, settings)).report["scene"]["warnings"])
    monkeypatch.setattr(memory, "available_bytes", lambda: plan.peak_bytes)
    assert memory.memory_warning(plan, settings) is None
    monkeypatch.setattr(memory, "available_bytes", lambda: None)
    assert memory.memory_warning(plan, settings) is None


def test_the_system_tells_how_much_memory_there_is():
    assert 1e7 < available_bytes() < 1e14
