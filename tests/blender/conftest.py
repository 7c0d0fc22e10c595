# SPDX-License-Identifier: GPL-3.0-or-later
"""Fixtures of the tests that need Blender."""

from __future__ import annotations

import bpy
import pytest


@pytest.fixture
def scene() -> bpy.types.Scene:
    """The only scene of an empty file."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    return bpy.context.scene
