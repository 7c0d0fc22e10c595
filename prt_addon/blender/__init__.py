# SPDX-License-Identifier: GPL-3.0-or-later
"""Blender in, Blender out: scene, materials and lights become arrays; baked transfer becomes attributes and properties.

The only folder of the core that knows bpy. Nothing here computes transfer, and nothing here leaves a trace in the
user's file beyond what `stored` writes.
"""
