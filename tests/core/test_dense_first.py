# SPDX-License-Identifier: GPL-3.0-or-later
"""Clustered PCA from dense points against the encoder on all points, and against the decoded signal itself."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from prt_addon.compression.dense_first import encode_dense_first
from prt_addon.compression.encoding import encode
from prt_addon.compression.settings import EncoderSettings
from prt_addon.errors import PRTError
from tests.core.test_sparse_sampling import ground, seen_past_sphere

SETTINGS = EncoderSettings(clusters=16, vectors=4, restarts=0, threads=1)


def smooth(side=48, r=8):
    """Visibility under a sphere, averaged over 3 x 3 points; the points."""
    positions, _ = ground(side)
    rows = seen_past_sphere(positions, r).reshape(side, side, -1)
    near = sum(np.roll(rows, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)) / 9
    return near.reshape(side * side, -1).astype(np.float32), positions


def every_fourth(positions):
    dense = np.zeros(len(positions), bool)
    dense[np.random.default_rng(0).permutation(len(positions))[:len(positions) // 4]] = True
    numbers = np.flatnonzero(dense)
    return dense, numbers[cKDTree(positions[dense]).query(positions)[1]]


def test_error_near_that_of_the_encoder_on_all_points():
    signal, positions = smooth()
    dense, joins = every_fourth(positions)
    found = encode_dense_first(signal, dense, joins, SETTINGS)
    whole = encode(signal, SETTINGS)
    assert found.squared_error < 1.25 * whole.squared_error
    decoded = float(np.sum((found.decode().astype(float) - signal) ** 2))
    assert found.squared_error == pytest.approx(decoded, rel=1e-3)
    assert found.relative_error == pytest.approx(decoded / np.sum(signal.astype(float) ** 2), rel=1e-3)
    assert len(found.bases) <= 16 and found.weights.shape == (len(signal), 4)


def test_sweeps_over_all_points_help():
    """Without them sparse points stay in the cluster of their dense point."""
    signal, positions = smooth()
    dense, joins = every_fourth(positions)
    found = encode_dense_first(signal, dense, joins, SETTINGS)
    notes = [error for _, stage, error in found.history if stage == "all points"]
    assert len(notes) == 1
    assert (found.cluster != found.cluster[joins]).mean() > 0.02


def test_wide_signal_counts_what_its_frame_leaves_out():
    signal, positions = smooth(40, 16)
    dense, joins = every_fourth(positions)
    found = encode_dense_first(signal, dense, joins, SETTINGS)
    decoded = float(np.sum((found.decode().astype(float) - signal) ** 2))
    assert found.squared_error == pytest.approx(decoded, rel=0.02)


def test_all_dense_one_cluster_and_constant():
    signal, _ = smooth(16)
    everyone = np.arange(len(signal))
    for settings in (SETTINGS, EncoderSettings(1, 4, threads=1), EncoderSettings(4, 0, "static", threads=1)):
        found = encode_dense_first(signal, np.ones(len(signal), bool), everyone, settings)
        assert found.squared_error < 1.1 * encode(signal, settings).squared_error + 1e-6
    flat = encode_dense_first(np.ones((20, 24), np.float32), np.arange(20) % 4 == 0, np.arange(20) // 4 * 4, SETTINGS)
    assert flat.squared_error < 1e-9


def test_bad_input_is_refused():
    signal, _ = smooth(8)
    dense = np.zeros(len(signal), bool)
    with pytest.raises(PRTError, match="not dense"):
        encode_dense_first(signal, dense, np.zeros(len(signal), int), SETTINGS)
    signal[3, 3] = np.nan
    with pytest.raises(PRTError, match="NaN"):
        encode_dense_first(signal, ~dense, np.arange(len(signal)), SETTINGS)
