# SPDX-License-Identifier: GPL-3.0-or-later
"""From baked transfer and light coefficients to exit radiance on the CPU: the oracle for the shaders."""
