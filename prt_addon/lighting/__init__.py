# SPDX-License-Identifier: GPL-3.0-or-later
"""Lights of every kind as coefficients of the lighting basis: radiance, W m^-2 sr^-1, linear Rec.709."""
