# SPDX-License-Identifier: GPL-3.0-or-later
"""Function bases over directions. Conventions, stated once for the whole product:

Real spherical harmonics, orthonormal over the sphere, without Condon-Shortley phase, so that band 1 is
sqrt(3 / 4 pi) * (y, z, x). Index i = l (l + 1) + m. Order n means n bands and n^2 functions (Sloan 2008).
Directions are unit vectors in Blender's world axes (right-handed, Z up), pointing away from the surface.
"""
