# SPDX-License-Identifier: GPL-3.0-or-later
"""Sparse sampling is chosen where elements are slow, and only there."""

from __future__ import annotations

import time

import numpy as np
import pytest

from prt_addon.transport.elements import MatrixElements
from prt_addon.transport.sparse_plan import break_even, element_seconds, plan


class Slow(MatrixElements):
    """Takes 20 microseconds an element."""

    def evaluate(self, receivers, columns):
        time.sleep(20e-6 * len(receivers))
        return super().evaluate(receivers, columns)


def test_the_cost_of_an_element_is_measured():
    slow = Slow(np.zeros((400, 96), np.float32))
    cost = element_seconds(slow)
    assert 20e-6 <= cost < 40e-6
    assert slow.asked == 3 * 400 * 16
    assert element_seconds(MatrixElements(np.zeros((400, 96), np.float32))) < 1e-6
    assert element_seconds(MatrixElements(np.zeros((0, 96), np.float32))) == 0.0
    assert element_seconds(Slow(np.zeros((1, 6), np.float32))) > 0.0


def test_slow_elements_pay_and_rays_do_not():
    rays = plan(50_000, 6144, 0.1e-6)
    assert not rays.pays and "left out" in rays.why
    paths = plan(50_000, 6144, 10e-6, unknown=1.0)
    assert paths.pays and paths.sparse_seconds < paths.all_seconds / 4
    carried = plan(50_000, 6144, 10e-6, unknown=1.0, operator=20.0)
    assert not carried.pays and "gather operator" in carried.why


def test_break_even_is_where_both_take_as_long():
    found = plan(1000, 96, break_even(96))
    assert found.all_seconds == pytest.approx(found.sparse_seconds)
