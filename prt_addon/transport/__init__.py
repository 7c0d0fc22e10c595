# SPDX-License-Identifier: GPL-3.0-or-later
"""Fills M_p: the linear map of a receiver from the lighting basis to the exit basis.

A fill is a generator that yields its progress (0..1) and returns its arrays, so that a bake can report, be cancelled
and stream. Diffuse fills: `direct` (shadowed) and `interreflection` (bounces through the `gather` operator).
`subsurface` takes their transfer through a translucent body.
"""
