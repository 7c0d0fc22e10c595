# SPDX-License-Identifier: GPL-3.0-or-later
"""What is baked: meshes in world space, their receivers, and what this scene needs.

Rule: geometry only, no rays (tracing) and no light. Points of a SceneMesh ARE the receivers.
"""
