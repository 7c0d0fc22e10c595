# SPDX-License-Identifier: GPL-3.0-or-later
"""The core: from a scene to exit radiance, in numpy and scipy alone.

Rule: nothing here imports bpy, gpu or mathutils, except the folder `blender`. Inside, a folder imports only folders
above it in the order scene, tracing, basis, transport, compression, lighting, relighting, storage, reporting, baking,
blender; `errors` and `linear_algebra` are the ground floor. `tests/rules` holds this.
"""
