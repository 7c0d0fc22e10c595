# SPDX-License-Identifier: GPL-3.0-or-later
"""Sparse sampling is left out by itself, and reports and plans say why with the seconds of both ways."""

from __future__ import annotations

from dataclasses import replace

from prt_addon.baking.plan import make_plan
from prt_addon.baking.recipe import bake, exhaust
from prt_addon.baking.settings import BakeSettings
from prt_addon.baking.sparse_choice import SPARSE, note_sparse, sparse_left_out
from prt_addon.scene.needs import LeftOut, Needs
from prt_addon.scene.scene_mesh import SceneMesh
from tests.core.shapes import plane, sphere

QUICK = BakeSettings(distant_basis="cubemap", cubemap_size=4, gather_directions=32, encoder="static", clusters=8,
                     vectors=4, spacing=0.0, error_receivers=0, threads=1)


def still_life():
    return SceneMesh.assemble([plane(size=4.0, cells=12), sphere(centre=(0, 0, 0.9), radius=0.8, subdivisions=3)])


def lines_of(left_out):
    return [item for item in left_out if (item["what"] if isinstance(item, dict) else item.what) == SPARSE]


def test_a_bake_in_texels_says_why_not_with_what_it_measured():
    foretold = lines_of(make_plan(still_life(), QUICK, None).needs.left_out)
    told = lines_of(exhaust(bake(still_life(), QUICK)).report["left_out"])
    assert len(foretold) == len(told) == 1
    for item in (foretold[0].why, told[0]["why"]):
        assert "tracing all of them takes about" in item and "interpolating the others" in item
    assert foretold[0].why != told[0]["why"]  # another time than the typical one


def test_other_bakes_do_not_mention_it():
    for more in ({"distant_basis": "sh", "order": 3}, {"lighting": "local"}):
        assert not lines_of(make_plan(still_life(), replace(QUICK, **more), None).needs.left_out)
    lone = SceneMesh.assemble([sphere(subdivisions=2)])  # convex: it needs no rays at all
    assert not lines_of(make_plan(lone, QUICK, None).needs.left_out)


def test_slow_elements_are_told_to_pay_only_where_asked_for():
    assert "only where it is asked for" in sparse_left_out(50_000, 1536, 10e-6).why
    assert "only where" not in sparse_left_out(50_000, 1536).why
    seconds = sparse_left_out(1_000_000, 6144, 1e-7).why
    assert "5 min 7 s" in seconds and "12 min 58 s" in seconds  # 0.05 us and 0.127 us an element


def test_a_later_line_takes_the_place_of_the_first():
    needs = Needs(True, True, 1, 3, [LeftOut("bounces", "a", "b"), sparse_left_out(10, 96)])
    note_sparse(needs, sparse_left_out(10, 96, 1.0))
    assert [item.what for item in needs.left_out] == ["bounces", SPARSE]
    note_sparse(needs, None)
    assert [item.what for item in needs.left_out] == ["bounces"]
