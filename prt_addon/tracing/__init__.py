# SPDX-License-Identifier: GPL-3.0-or-later
"""Rays. The only folder that imports embreex; everything above asks the Tracer."""
