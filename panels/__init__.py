# SPDX-License-Identifier: GPL-3.0-or-later
"""Panels. Rule: they draw properties and operators, never compute, and import neither the core nor the operators."""
