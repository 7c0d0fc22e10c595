# SPDX-License-Identifier: GPL-3.0-or-later
"""Point, Spot and Area lights as they are read, against what Cycles bakes of them on small white facets."""

from __future__ import annotations

import math
import warnings

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from prt_addon.blender.local_lights import read_local_lights
from prt_addon.errors import PRTError
from prt_addon.relighting.direct_light import LitReceivers, direct_local_light
from prt_addon.tracing.tracer import Tracer
from tests.blender.cycles import baked_irradiance, diffuse_material, use_cycles

UP = (0.0, 0.0, 1.0)


def add_lamp(kind, matrix=None, watts=40.0, **options):
    data = bpy.data.lights.new("Lamp", kind)
    data.energy, data.color = watts, (1.0, 0.5, 0.25)
    data.shadow_soft_size = 0.0
    for name, value in options.items():
        setattr(data, name, value)
    placed = bpy.data.objects.new("Lamp", data)
    bpy.context.scene.collection.objects.link(placed)
    placed.matrix_world = Matrix.Translation((0.0, 0.0, 2.0)) if matrix is None else matrix
    return placed


def add_facets(positions, normals):
    """White triangles of 2 mm about the positions (n, 3), which hide nothing."""
    normals = np.broadcast_to(np.asarray(normals, float), positions.shape)
    helper = np.where(np.abs(normals[:, 2:]) < 0.9, [UP], [[1.0, 0, 0]])
    across = np.cross(helper, normals)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along = np.cross(normals, across)
    turns = 2 * math.pi * np.arange(3) / 3
    corners = positions + 1e-3 * (np.cos(turns)[:, None, None] * across + np.sin(turns)[:, None, None] * along)
    corners = corners.transpose(1, 0, 2).reshape(-1, 3)
    mesh = bpy.data.meshes.new("Facets")
    mesh.from_pydata(corners.tolist(), [], np.arange(len(corners)).reshape(-1, 3).tolist())
    mesh.materials.append(diffuse_material("White", (1, 1, 1, 1)))
    facets = bpy.data.objects.new("Facets", mesh)
    # neither from the lamps nor from rays that find a wide lamp by the surface's own samples
    facets.visible_shadow = facets.visible_diffuse = False
    bpy.context.scene.collection.objects.link(facets)
    return facets


def add_plate(low, high, height):
    """A black level plate between two corners that hides lights; returns its points and triangles too."""
    (a, b), (c, d) = low, high
    points = np.array([[a, b, height], [c, b, height], [c, d, height], [a, d, height]], float)
    mesh = bpy.data.meshes.new("Plate")
    mesh.from_pydata(points.tolist(), [], [(0, 1, 2, 3)])
    mesh.materials.append(diffuse_material("Black", (0, 0, 0, 1)))
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("Plate", mesh))
    return points, np.array([[0, 1, 2], [0, 2, 3]], np.int32)


def read(lines=None):
    bpy.context.view_layer.update()
    return read_local_lights(bpy.context.evaluated_depsgraph_get(), [] if lines is None else lines)


def both(positions, normals=UP, samples=1, occluder=None, ours_samples=64):
    """E / pi (n, 3) of the file's lamps on facets: ours and Cycles'."""
    use_cycles(samples)
    positions = np.asarray(positions, float)
    normals = np.broadcast_to(np.asarray(normals, float), positions.shape)
    facets = add_facets(positions, normals)
    bpy.context.view_layer.update()
    theirs = baked_irradiance(facets)
    bpy.data.objects.remove(facets)
    corners = np.concatenate([positions - 5.0, positions + 5.0])
    points, triangles = occluder or (corners, np.zeros((0, 3), np.int32))
    tracer = Tracer(points, triangles, 1)
    ours = direct_local_light(tracer, LitReceivers.of_points(tracer, positions, normals), read(), ours_samples)
    return ours, theirs


def line(count=41, reach=2.0, height=0.0):
    x = np.linspace(-reach, reach, count)
    return np.stack([x, 0 * x, 0 * x + height], axis=1)


def assert_close(ours, theirs, share):
    """Within a share of the peak everywhere, and lit at all."""
    assert theirs.max() > 0.0
    assert np.abs(ours - theirs).max() < share * theirs.max()


TILTED = np.array([UP, (0.6, 0, 0.8), (0.96, 0, 0.28), (0, -0.6, 0.8), (0, 0.6, -0.8)])


@pytest.mark.usefixtures("scene")
def test_a_hard_point_equals_cycles() -> None:
    add_lamp("POINT")
    places = np.array([[0, 0, 0], [0, 0, 1.5], [0, 0, -20.0], [1, 0, 0], [0, 3, 0]], float)
    positions, normals = np.repeat(places, len(TILTED), axis=0), np.tile(TILTED, (len(places), 1))
    ours, theirs = both(positions, normals)
    np.testing.assert_allclose(ours, theirs, rtol=1e-3, atol=1e-6)
    assert ours[0] == pytest.approx(40 / (4 * math.pi) / 4 / math.pi * np.array([1, 0.5, 0.25]), rel=1e-3)


@pytest.mark.usefixtures("scene")
@pytest.mark.parametrize(("degrees", "blend", "scale"), [
    (45, 0.0, (1, 1, 1)), (45, 0.15, (1, 1, 1)), (110, 1.0, (1, 1, 1)), (180, 0.5, (1, 1, 1)), (70, 0.4, (3, 1, 2)),
    (70, 0.4, (1, 1, -1))])
def test_a_hard_spot_equals_cycles(degrees, blend, scale) -> None:
    matrix = Matrix.Translation((0.1, 0, 2.0)) @ Matrix.Rotation(0.2, 4, "Y") @ Matrix.Diagonal((*scale, 1))
    lamp = add_lamp("SPOT", matrix, spot_size=math.radians(degrees), spot_blend=blend)
    axis = np.array(lamp.matrix_world.to_3x3())[:, 2]
    axis /= np.linalg.norm(axis)
    on_axis = np.array(lamp.matrix_world.translation) - 2.0 * axis
    ours, theirs = both(np.concatenate([[on_axis], line(61, 2.5)]), [axis, *[UP] * 61])
    np.testing.assert_allclose(ours[0], theirs[0], rtol=5e-3)
    if blend:
        assert_close(ours, theirs, 2e-3)  # the profile of the penumbra
    else:  # one facet may lie on the very edge
        assert np.count_nonzero(np.abs(ours - theirs).max(axis=1) > 2e-3 * theirs.max()) <= 1
        assert np.count_nonzero(theirs[:, 0] == 0.0) > 5


@pytest.mark.usefixtures("scene")
@pytest.mark.parametrize("soft_falloff", [True, False])
@pytest.mark.parametrize("radius", [0.1, 0.8])
def test_a_point_with_a_radius_equals_cycles(soft_falloff, radius) -> None:
    """Near, far, grazing, and within the ball itself."""
    add_lamp("POINT", shadow_soft_size=radius, use_soft_falloff=soft_falloff)
    places = np.array([[0, 0, 0.5], [0, 0, 1.0], [0.6, 0, 1.5], [0, 3.0, 0], [0.2, 0, 1.7]])
    positions, normals = np.repeat(places, len(TILTED), axis=0), np.tile(TILTED, (len(places), 1))
    ours, theirs = both(positions, normals, 1024)
    np.testing.assert_allclose(ours, theirs, rtol=1e-2, atol=3e-3 * theirs.max())


@pytest.mark.usefixtures("scene")
def test_within_the_ball_of_a_spot_equals_cycles_where_cycles_agrees_with_itself() -> None:
    """Before the lamp's middle. Elsewhere within the ball Cycles' two ways to find light disagree about the cone: one
    knows it, the other does not, and the bake shows their mean; here there is no cone."""
    add_lamp("SPOT", shadow_soft_size=0.8, use_soft_falloff=False, spot_size=0.6, spot_blend=0.3)
    ours, theirs = both([[0, 0, 1.5], [0, 0, 0.8], [0.7, 0, 0.8]], samples=1024)
    np.testing.assert_allclose(ours, theirs, rtol=1e-2, atol=1e-2 * theirs.max())


@pytest.mark.usefixtures("scene")
@pytest.mark.parametrize("soft_falloff", [True, False])
def test_a_spot_with_a_radius_equals_cycles(soft_falloff) -> None:
    add_lamp("SPOT", shadow_soft_size=0.3, use_soft_falloff=soft_falloff, spot_size=0.9, spot_blend=0.2)
    ours, theirs = both(line(), samples=1024)
    np.testing.assert_allclose(ours[20], theirs[20], rtol=1e-2)
    assert_close(ours, theirs, 2e-2)


@pytest.mark.usefixtures("scene")
@pytest.mark.parametrize("shape", ["SQUARE", "RECTANGLE", "DISK", "ELLIPSE"])
def test_an_area_equals_cycles_near_and_far(shape) -> None:
    matrix = Matrix.Translation((0.1, 0, 2.0)) @ Matrix.Rotation(0.3, 4, "Y") @ Matrix.Diagonal((1.5, 0.5, 7.0, 1))
    add_lamp("AREA", matrix, shape=shape, size=0.8, size_y=0.5)
    places = np.array([[0, 0, 1.5], [0.3, 0.2, 1.0], [-0.8, 0, 0], [1.0, 1, 0], [0, 0, -6.0]])
    positions, normals = np.repeat(places, len(TILTED), axis=0), np.tile(TILTED, (len(places), 1))
    ours, theirs = both(positions, normals, 1024)
    np.testing.assert_allclose(ours, theirs, rtol=1e-2, atol=2e-3 * theirs.max())


@pytest.mark.usefixtures("scene")
@pytest.mark.parametrize(("shape", "degrees"), [("RECTANGLE", 120), ("RECTANGLE", 40), ("ELLIPSE", 90), ("DISK", 20)])
def test_the_spread_of_an_area_equals_cycles(shape, degrees) -> None:
    add_lamp("AREA", shape=shape, size=0.8, size_y=0.5, spread=math.radians(degrees))
    positions = np.concatenate([line(31, 1.5), line(11, 0.6, 1.5)])
    ours, theirs = both(positions, samples=1024)
    assert_close(ours[:31], theirs[:31], 2e-2)
    assert_close(ours[31:], theirs[31:], 2e-2)


@pytest.mark.usefixtures("scene")
@pytest.mark.parametrize(("kind", "options"), [
    ("POINT", {"shadow_soft_size": 0.3}), ("POINT", {"shadow_soft_size": 0.3, "use_soft_falloff": False}),
    ("AREA", {"size": 0.6}), ("AREA", {"size": 0.6, "spread": 1.0}), ("POINT", {})])
def test_the_shadow_of_an_edge_equals_cycles(kind, options) -> None:
    add_lamp(kind, **options)
    plate = add_plate((-30, -30), (0, 30), 1.0)
    ours, theirs = both(line(40, 1.0), samples=512, occluder=plate, ours_samples=256)
    assert_close(ours, theirs, 2e-2)
    assert not theirs[0].any()
    assert not ours[0].any()


@pytest.mark.usefixtures("scene")
@pytest.mark.parametrize(("kind", "options"), [
    ("POINT", {}), ("POINT", {"shadow_soft_size": 0.2}), ("SPOT", {"shadow_soft_size": 0.03}),
    ("AREA", {"size": 0.6, "size_y": 0.3, "shape": "RECTANGLE"}), ("AREA", {"size": 0.6, "shape": "DISK"})])
def test_power_without_normalizing_equals_cycles(kind, options) -> None:
    matrix = Matrix.Translation((0, 0, 2.0)) @ Matrix.Diagonal((2.0, 0.5, 3.0, 1))
    add_lamp(kind, matrix, normalize=False, exposure=1.5, use_temperature=True, temperature=3200.0, **options)
    ours, theirs = both([[0.0, 0, 0], [0.3, 0, 0.5]], samples=256)
    np.testing.assert_allclose(ours, theirs, rtol=1e-2)


def with_nodes(lamp, strength=2.0, colour=(0.5, 1.0, 0.2, 1.0)):
    if lamp.data.node_tree is None:
        lamp.data.use_nodes = True
    emission = lamp.data.node_tree.nodes["Emission"]
    emission.inputs["Strength"].default_value = strength
    emission.inputs["Color"].default_value = colour
    return lamp.data.node_tree, emission


@pytest.mark.usefixtures("scene")
def test_constant_nodes_equal_cycles() -> None:
    with_nodes(add_lamp("POINT"))
    ours, theirs = both([[0.0, 0, 0]])
    np.testing.assert_allclose(ours, theirs, rtol=2e-3)


@pytest.mark.usefixtures("scene")
def test_nodes_that_are_switched_off_do_nothing() -> None:
    lamp = add_lamp("POINT")
    with_nodes(lamp)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # the switch goes with Blender 6
        lamp.data.use_nodes = False
    ours, theirs = both([[0.0, 0, 0]])
    np.testing.assert_allclose(ours, theirs, rtol=2e-3)


@pytest.mark.usefixtures("scene")
def test_what_only_other_engines_read_does_nothing() -> None:
    add_lamp("SPOT", diffuse_factor=0.2, use_custom_distance=True, cutoff_distance=0.5, use_square=True, spot_size=1.5)
    ours, theirs = both(line(9))
    np.testing.assert_allclose(ours, theirs, rtol=2e-3)


@pytest.mark.usefixtures("scene")
def test_other_nodes_are_said_and_none_give_no_light() -> None:
    tree, emission = with_nodes(add_lamp("POINT"))
    noise = tree.nodes.new("ShaderNodeTexNoise")
    tree.links.new(noise.outputs[0], emission.inputs["Strength"])
    lines: list[str] = []
    np.testing.assert_allclose(read(lines)[0].power, 40.0 * np.array([1, 0.5, 0.25]))
    assert "more than a constant Emission" in lines[0]
    tree.links.clear()
    assert read() == []
    use_cycles(1)
    assert not baked_irradiance(add_facets(np.zeros((1, 3)), UP)).any()


@pytest.mark.usefixtures("scene")
def test_instances_shine_each_with_its_own_key() -> None:
    lamp = add_lamp("POINT", Matrix.Translation((0, 0, 1.0)))
    group = bpy.data.collections.new("Group")
    group.objects.link(lamp)
    bpy.context.scene.collection.objects.unlink(lamp)
    for name, x in (("A", -1.0), ("B", 2.0)):
        holder = bpy.data.objects.new(name, None)
        holder.instance_type, holder.instance_collection = "COLLECTION", group
        bpy.context.scene.collection.objects.link(holder)
        holder.matrix_world = Matrix.Translation((x, 0, 1.0))
    found = read()
    np.testing.assert_allclose([light.position for light in found], [[-1, 0, 2], [2, 0, 2]], atol=1e-6)
    assert len({light.key for light in found}) == 2
    ours, theirs = both(line(9))
    np.testing.assert_allclose(ours, theirs, rtol=2e-3)
    bpy.data.objects["A"].matrix_world = Matrix.Translation((5, 0, 1.0))
    assert [light.key for light in read()] == [light.key for light in found]
    bpy.data.objects["B"].hide_render = True
    assert len(read()) == 1


@pytest.mark.usefixtures("scene")
def test_what_a_render_does_not_show_gives_no_light() -> None:
    hidden, dark, portal, black, unseen, sun = (add_lamp(kind) for kind in (
        "POINT", "SPOT", "AREA", "POINT", "AREA", "SUN"))
    hidden.hide_render = True
    dark.visible_diffuse = False
    portal.data.cycles.is_portal = True
    black.data.energy = 0.0
    unseen.scale = (0.0, 1.0, 1.0)
    sun.name = "Sun"
    portal.name, dark.name = "Portal", "Dark"
    lines: list[str] = []
    assert read(lines) == []
    assert len(lines) == 3  # of the ray visibility, the portal and the area without area
    for name in ("Dark: its ray visibility", "Portal: a portal", "Lamp.004: an Area light without any area"):
        assert any(line.startswith(name) for line in lines), lines


@pytest.mark.usefixtures("scene")
def test_a_lamp_that_only_the_viewport_hides_shines() -> None:
    lamp = add_lamp("POINT")
    bpy.context.view_layer.update()
    lamp.hide_viewport = True
    lines: list[str] = []
    found = read(lines)
    assert [light.name for light in found] == ["Lamp"]
    np.testing.assert_allclose(found[0].position, [0, 0, 2])
    assert "the viewport hides it" in lines[0]


@pytest.mark.usefixtures("scene")
def test_what_is_not_done_is_said() -> None:
    lamp = add_lamp("SPOT", use_shadow=False)
    lamp.data.cycles.max_bounces = 2
    lamp.light_linking.receiver_collection = bpy.data.collections.new("Lit")
    lamp.light_linking.blocker_collection = bpy.data.collections.new("Shadows")
    tree, emission = with_nodes(lamp)
    falloff = tree.nodes.new("ShaderNodeLightFalloff")
    profile = tree.nodes.new("ShaderNodeTexIES")
    tree.links.new(profile.outputs[0], falloff.inputs["Strength"])
    tree.links.new(falloff.outputs["Linear"], emission.inputs["Strength"])
    lines: list[str] = []
    (light,) = read(lines)
    assert not light.shadow
    for words in ("no shadow", "2 bounces", "light linking", "shadow linking", "IES profile", "Light Falloff"):
        assert sum(words in line for line in lines) == 1, (words, lines)
    assert all(line.startswith("Lamp") for line in lines)


@pytest.mark.usefixtures("scene")
def test_a_lamp_without_shadow_shines_through_as_in_cycles() -> None:
    add_lamp("POINT", use_shadow=False)
    ours, theirs = both(line(9), occluder=add_plate((-30, -30), (0, 30), 1.0))
    np.testing.assert_allclose(ours, theirs, rtol=2e-3)


@pytest.mark.usefixtures("scene")
def test_extremes_and_broken_numbers() -> None:
    for watts in (1e-6, 1e9, -3.0):
        lamp = add_lamp("POINT", watts=watts)
        np.testing.assert_allclose(read()[0].power, watts * np.array([1, 0.5, 0.25]), rtol=1e-6)
        bpy.data.objects.remove(lamp)
    add_lamp("POINT", watts=float("inf"))
    with pytest.raises(PRTError, match="Lamp"):
        read()


@pytest.mark.usefixtures("scene")
def test_a_parent_that_shears_an_area_is_said() -> None:
    lamp = add_lamp("AREA")
    parent = bpy.data.objects.new("Parent", None)
    bpy.context.scene.collection.objects.link(parent)
    parent.scale = (3.0, 1.0, 1.0)
    lamp.parent, lamp.matrix_world = parent, Matrix.Identity(4)
    lamp.matrix_local = Matrix.Rotation(0.6, 4, "Z")
    lines: list[str] = []
    assert len(read(lines)) == 1
    assert "shears" in lines[0]
