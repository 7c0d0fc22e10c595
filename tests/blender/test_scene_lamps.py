# SPDX-License-Identifier: GPL-3.0-or-later
"""Lamps on bakes step by step, as the viewport has them: dragged, hidden casters, what the panel says of the cloud."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
import pytest

from tests.blender.test_local_light_bakes import FAST, make_room, run


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A room baked for lamps."""
    folder = tmp_path_factory.mktemp("lamps")
    scene, output = make_room(folder / "room.blend"), folder / "baked.blend"
    assert run("bake", "--input", scene, "--output", output, "--lighting", "local", "--set", "cloud_region=Region",
               *FAST, "--set", "cloud_lights=27") == 0
    return output


def opened(room: Path) -> tuple:
    """A fresh SceneLamps, the bakes by name and the depsgraph."""
    from prt.operators.scene_lamps import SceneLamps
    from prt.prt_addon.blender.stored import baked_objects, read_baked

    bpy.ops.wm.open_mainfile(filepath=str(room))
    depsgraph = bpy.context.evaluated_depsgraph_get()
    return SceneLamps(), {o.name: read_baked(o) for o in baked_objects(bpy.context.scene)}, depsgraph


def test_a_dragged_lamp_gets_few_rays_and_one_that_stays_none(room: Path) -> None:
    from prt.operators.scene_lamps import moved_lamps

    lamps_of, baked, depsgraph = opened(room)
    bpy.data.lights["Lamp"].shadow_soft_size = 0.1
    bpy.context.view_layer.update()
    before = lamps_of.step(baked, depsgraph, [])
    still = lamps_of.direct("Floor", baked["Floor"], before)
    bpy.data.objects["Lamp"].location.x -= 0.2
    bpy.context.view_layer.update()
    lamps = lamps_of.step(baked, depsgraph, [])
    assert moved_lamps(lamps, before) == {"Lamp"} and not moved_lamps(lamps, lamps) and not moved_lamps(lamps, [])
    rays = lamps_of._tracers[b""].rays
    quick = lamps_of.direct("Floor", baked["Floor"], lamps, {"Lamp"})
    few = lamps_of._tracers[b""].rays - rays
    fine = lamps_of.direct("Floor", baked["Floor"], lamps)
    assert lamps_of._tracers[b""].rays - rays - few > 3 * few > 0
    assert np.abs(quick - fine).max() < 0.5 * fine.max() and np.abs(quick - still).max() > 0.1 * still.max()
    bpy.data.lights["Lamp"].energy *= 2.0
    bpy.context.view_layer.update()
    bright = lamps_of.step(baked, depsgraph, [])
    rays = lamps_of._tracers[b""].rays
    assert not moved_lamps(bright, lamps)
    assert np.allclose(lamps_of.direct("Floor", baked["Floor"], bright), 2.0 * fine, rtol=1e-5)
    assert lamps_of._tracers[b""].rays == rays


def test_baked_objects_hidden_in_renders_hide_nothing_and_break_nothing(room: Path) -> None:
    lamps_of, baked, _ = opened(room)
    bpy.data.objects["Left"].hide_render = True
    depsgraph, warnings = bpy.context.evaluated_depsgraph_get(), []
    lamps = lamps_of.step(baked, depsgraph, warnings)
    assert lamps and not warnings
    assert lamps_of.direct("Floor", baked["Floor"], lamps).max() > 0.0
    for found in baked:
        bpy.data.objects[found].hide_render = True
    lamps_of.forget_geometry()
    assert lamps_of.step(baked, depsgraph, warnings) == [] and "hidden in renders" in warnings[0]
    assert lamps_of.direct("Floor", baked["Floor"], []) is None and lamps_of.cloud_light(baked["Floor"]) is None
    assert lamps_of.settled and not lamps_of.outside


def test_a_bake_without_lamps_beside_others_is_told(room: Path, tmp_path: Path,
                                                    capsys: pytest.CaptureFixture[str]) -> None:
    mixed = tmp_path / "mixed.blend"
    assert run("bake", "--input", room, "--output", mixed, "--objects", "Back", *FAST) == 0
    for source, told in ((room, False), (mixed, True)):
        capsys.readouterr()
        assert run("relight", "--input", source, "--output", tmp_path / "a.npz", "--use-scene-lights") == 0
        assert ("Back: baked without lamps, which light the rest" in capsys.readouterr().err) == told
    for more in ((), ("--use-scene-lights", "--lamps-by-directions")):
        assert run("relight", "--input", mixed, "--output", tmp_path / "a.npz", *more) == 0
        assert "baked without lamps" not in capsys.readouterr().err


def test_the_panel_tells_of_the_cloud(room: Path) -> None:
    from prt.operators.scene_lamps import cloud_key, cloud_lines

    _, baked, _ = opened(room)
    lines = cloud_lines(baked["Floor"].cloud).splitlines()
    assert lines[0].endswith(" m") and "lights every" in lines[0]
    assert lines[1].startswith("merged to ") and "zone" in lines[1] and "column" in lines[2]
    assert cloud_key(baked["Floor"]) == cloud_key(baked["Left"])


def test_errors_are_told_under_the_right_names(room: Path) -> None:
    from prt.operators.live_preview import _errors_of

    _, baked, _ = opened(room)
    transfer = baked["Floor"]
    for lighting, expected in (("local", (-1.0, -1.0, 0.1, -1.0)), ("environment,local", (0.1, -1.0, 0.2, -1.0))):
        transfer.header.update(errors={"total": 0.1}, local_errors={"total": 0.2}, own_errors={},
                               settings={"lighting": lighting})
        assert _errors_of(transfer) == expected
    transfer.header["own_errors"] = {"diffuse": 0.01, "bounced light of lamps": 0.02}
    assert _errors_of(transfer) == (0.01, -1.0, 0.02, -1.0)
