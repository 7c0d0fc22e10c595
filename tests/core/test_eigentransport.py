# SPDX-License-Identifier: GPL-3.0-or-later
"""Eigentransport against exact singular values, the one-cluster encoder and the paper's equations."""

import numpy as np
import pytest
from scipy import linalg

from prt_addon.compression.eigentransport import MOST_VECTORS, eigentransport, mean_compensated
from prt_addon.compression.encoding import pca
from prt_addon.errors import BadArguments, Cancelled, PRTError
from prt_addon.transport.column_arrays import column_array


def made_signal(points, values, decay=0.6, seed=1):
    """A matrix whose singular values fall slowly, as k^-decay, about a mean."""
    random = np.random.default_rng(seed)
    size = min(points, values)
    left = linalg.qr(random.normal(size=(points, size)), mode="economic")[0]
    right = linalg.qr(random.normal(size=(values, size)), mode="economic")[0]
    values_of = np.arange(1, size + 1) ** -decay
    return ((left * values_of) @ right.T + 0.05 * random.random(values)).astype(np.float32)


@pytest.mark.parametrize("shape", [(300, 96), (60, 384)])
@pytest.mark.parametrize("order", ["C", "F"])
def test_small_signals_are_solved_exactly(shape, order):
    signal = np.asarray(made_signal(*shape), order=order)
    scale = np.random.default_rng(2).uniform(0.5, 2.0, shape[1])
    found = eigentransport(signal, 24, scale)
    assert found.exact
    centred = (signal - signal.mean(axis=0)).astype(float) * scale
    singular = linalg.svdvals(centred)
    assert np.allclose(found.captured, np.cumsum(singular[:24] ** 2) / np.sum(singular ** 2), rtol=1e-5)
    assert found.encoding.squared_error == pytest.approx(np.sum(singular[24:] ** 2), rel=1e-4)
    left, values, right = linalg.svd(centred, full_matrices=False)
    best = (left[:, :24] * values[:24]) @ right[:24] / scale + signal.mean(axis=0)
    assert np.abs(found.encoding.decode() - best).max() < 1e-4 * np.abs(signal).max()
    axes = found.encoding.bases[0, 1:].astype(float) * scale
    assert np.allclose(axes @ axes.T, np.eye(24), atol=1e-5)


def test_captured_variance_rises_to_all_of_it():
    signal = made_signal(80, 60)
    found = eigentransport(signal, 60)
    assert (np.diff(found.captured) > 0).all()
    assert found.captured[-1] == pytest.approx(1.0, abs=1e-6)
    assert np.abs(found.encoding.decode() - signal).max() < 1e-5


@pytest.mark.parametrize("order", ["C", "F"])
def test_a_random_sample_captures_nearly_what_exact_ones_do(order):
    signal = np.asarray(made_signal(2500, 1500, 0.5), order=order)
    sampled = eigentransport(signal, 48, exact=False)
    exact = eigentransport(signal, 48, exact=True)
    assert not sampled.exact
    assert 0 <= exact.captured[-1] - sampled.captured[-1] < 0.02 * exact.captured[-1]
    measured = np.square(signal - sampled.encoding.decode(), dtype=float).sum()
    assert sampled.encoding.squared_error == pytest.approx(measured, rel=1e-4)
    axes = sampled.encoding.bases[0, 1:].astype(float)
    assert np.allclose(axes @ axes.T, np.eye(48), atol=1e-5)


def test_a_signal_of_low_rank_is_found_whole_from_a_sample():
    random = np.random.default_rng(4)
    signal = (random.normal(size=(1500, 20)) @ random.normal(size=(20, 1200))).astype(np.float32)
    found = eigentransport(signal, 32)
    assert not found.exact and found.encoding.weights.shape[1] in range(20, 33)
    assert np.linalg.norm(found.encoding.decode() - signal) < 1e-5 * np.linalg.norm(signal)


def test_it_is_the_encoder_with_one_cluster():
    signal = made_signal(500, 96)
    ours, theirs = eigentransport(signal, 12).encoding, pca(signal, 12)
    assert len(theirs.bases) == len(ours.bases) == 1
    assert ours.squared_error == pytest.approx(theirs.squared_error, rel=1e-4)
    assert np.abs(ours.decode() - theirs.decode()).max() < 1e-4 * np.abs(signal).max()
    assert ours.storage_cost == theirs.storage_cost


def test_columns_on_disk_give_the_same(tmp_path):
    signal = made_signal(1300, 1100)
    stored = column_array(1100, 1300, budget=0, folder=tmp_path)
    stored[:] = signal.T
    there, here = eigentransport(stored.T, 16), eigentransport(np.asfortranarray(signal), 16)
    assert not there.exact
    assert np.array_equal(there.encoding.weights, here.encoding.weights)
    rows = eigentransport(signal, 16)
    assert np.allclose(rows.captured, here.captured, rtol=1e-5)


def test_mean_compensation_is_the_papers():
    signal = made_signal(200, 64) + 0.3 * np.random.default_rng(8).random(64).astype(np.float32)
    scale = np.random.default_rng(3).uniform(0.5, 2.0, 64)
    light = np.random.default_rng(9).random(64)
    found = eigentransport(signal, 16, scale).encoding
    weights, projected = mean_compensated(found, scale)
    # Equations 3 to 9, written out in the orthonormal basis: columns times the scale, light over it.
    basis = found.bases[0, 1:].astype(float) * scale
    mean, seen = found.bases[0, 0] * scale, light / scale
    light_coefficients = (seen - mean) @ basis.T + projected
    transport = (signal * scale - mean) @ basis.T + mean @ basis.T
    assert np.allclose(projected, mean @ basis.T, rtol=1e-5)
    assert np.allclose(weights, transport, atol=1e-4)
    published = transport @ light_coefficients
    assert np.allclose(weights @ light_coefficients, published, rtol=1e-4)
    # Ours differs by the light on what of the mean lies outside the basis, and by nothing else.
    outside = (mean - (mean @ basis.T) @ basis) @ seen
    ours = found.decode() @ light
    assert np.allclose(ours - published, outside, atol=1e-4 * np.abs(ours).max())
    assert abs(outside) > 1e-2 * np.abs(ours).mean()


def test_a_target_takes_the_fewest_vectors():
    signal = made_signal(300, 96)
    found = eigentransport(signal, 80, target_error=0.05)
    fewer = found.encoding.weights.shape[1] - 1
    assert found.encoding.relative_error <= 0.05 < eigentransport(signal, fewer).encoding.relative_error


def test_memory_is_the_papers():
    assert eigentransport(made_signal(100, 60), 48).bytes() == 4 * 48 * 101


def test_extreme_signals():
    constant = np.full((50, 24), 0.3, np.float32)
    found = eigentransport(constant, 12)
    assert found.encoding.bases.shape == (1, 1, 24) and found.encoding.squared_error < 1e-10
    assert np.allclose(found.encoding.decode(), constant)
    assert np.array_equal(eigentransport(np.zeros((5, 24), np.float32), 3).encoding.decode(), np.zeros((5, 24)))
    one = eigentransport(np.random.default_rng(1).random((1, 24)).astype(np.float32), 5)
    assert one.encoding.weights.shape == (1, 0)
    doubled = np.repeat(made_signal(20, 24), 10, axis=0)  # duplicated vertices
    assert np.abs(eigentransport(doubled, 24).encoding.decode() - doubled).max() < 1e-5
    large = eigentransport(made_signal(60, 30) * np.float32(1e6), 30)
    assert large.captured[-1] == pytest.approx(1.0, abs=1e-6)


def test_bad_input_and_cancel():
    signal = made_signal(30, 24)
    for vectors in (0, MOST_VECTORS + 1):
        with pytest.raises(BadArguments):
            eigentransport(signal, vectors)
    with pytest.raises(BadArguments):
        eigentransport(signal, 4, np.zeros(24))
    signal[3, 4] = np.nan
    with pytest.raises(PRTError, match="point 3"):
        eigentransport(signal, 4)

    def stop(fraction):
        if fraction > 0.3:
            raise Cancelled("bake", "cancelled", "again")

    with pytest.raises(Cancelled):
        eigentransport(made_signal(30, 24), 4, progress=stop)
