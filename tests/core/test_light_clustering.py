# SPDX-License-Identifier: GPL-3.0-or-later
"""Merging of lights against scipy's full distance matrices and harmonic means."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import pdist, squareform
from scipy.stats import hmean

from prt_addon.lighting import light_clustering
from prt_addon.lighting.light_clustering import (
    FAR,
    default_weights,
    largest_response,
    light_distances,
    merge_lights,
    merged_positions,
    merged_response,
    mutual_visibility,
)
from prt_addon.tracing.tracer import Tracer
from tests.core.shapes import box, join

ROOM = join("room", box(inward=True), box(low=(0.49, 0, 0), high=(0.51, 1, 1)))
TRACER = Tracer(ROOM.positions, ROOM.triangles, 1)


def problem(lights, receivers, values, seed=0):
    """Lights in a unit box and the fields that they make on receivers in its walls, different in every value."""
    rng = np.random.default_rng(seed)
    positions, places = rng.uniform(0, 1, (lights, 3)), rng.uniform(0, 1, (receivers, 3))
    places[np.arange(receivers), rng.integers(0, 3, receivers)] = rng.integers(0, 2, receivers)
    squared = ((places[:, None] - positions) ** 2).sum(axis=2)
    responses = np.stack([np.cos(v * squared) / (0.2 + 0.1 * v + squared) for v in range(values)], axis=2)
    return positions, responses.astype(np.float32)


def plain_distances(positions, responses, w1, w2):
    largest = np.zeros((len(positions),) * 2)
    for receiver in responses.astype(float):
        largest = np.maximum(largest, squareform(pdist(receiver)))
    return w1 * pdist(positions) + w2 * squareform(largest, checks=False)


def same_partition(a, b):
    return len(set(zip(a.tolist(), b.tolist(), strict=True))) == len(set(a.tolist())) == len(set(b.tolist()))


@pytest.mark.parametrize("values", [1, 3, 7])
@pytest.mark.parametrize("difference", [0.03, 0.15, 0.6])
def test_distances_and_clusters_are_those_of_all_pairs(monkeypatch, values, difference):
    monkeypatch.setattr(light_clustering, "BLOCK_NUMBERS", 9000)  # several blocks
    positions, responses = problem(90, 400, values)
    w1, w2 = default_weights(3 ** 0.5, largest_response(responses), 0.5, difference)
    full = plain_distances(positions, responses, w1, w2)
    found = light_distances(positions, responses, w1, w2)
    assert np.array_equal(found < 1, full < 1) and np.allclose(found[full < 1], full[full < 1], rtol=1e-4)
    assert (found[full >= 1] >= 1).all()
    labels = merge_lights(positions, responses, None, w1, w2)
    expected = fcluster(linkage(full, "complete"), np.nextafter(1.0, 0.0), "distance")
    assert same_partition(labels, expected)
    firsts = [np.flatnonzero(labels == c)[0] for c in range(labels.max() + 1)]
    assert firsts == sorted(firsts)
    pairs = squareform(full)
    assert all(pairs[np.ix_(labels == c, labels == c)].max() < 1 for c in range(labels.max() + 1))


def test_one_value_is_chebyshevs_distance():
    positions, responses = problem(60, 5000, 1, 3)
    full = 2.0 * pdist(positions) + 1.5 * pdist(responses[:, :, 0].T.astype(float), "chebyshev")
    found = light_distances(positions, responses, 2.0, 1.5)
    assert np.array_equal(found < 1, full < 1) and np.allclose(found[full < 1], full[full < 1], rtol=1e-5)


def test_lights_on_both_sides_of_a_wall_stay_apart():
    positions, responses = problem(80, 50, 1)
    positions = positions[np.abs(positions[:, 0] - 0.5) > 0.02]
    responses = responses[:, :len(positions)]
    labels = merge_lights(positions, responses, mutual_visibility(TRACER, positions), 0.0, 0.0)
    assert same_partition(labels, positions[:, 0] < 0.5)
    assert merge_lights(positions, responses, None, 0.0, 0.0).max() == 0


def test_extreme_weights():
    positions, responses = problem(20, 100, 2)
    positions[7], responses[:, 7] = positions[3], responses[:, 3]  # two lights are one
    alone = np.delete(np.arange(20), 7)
    for w1, w2 in ((1e300, 0.0), (0.0, 1e300), (1e300, 1e300), (1e12, 1e12)):
        labels = merge_lights(positions, responses, None, w1, w2)
        assert labels[7] == labels[3] and len(set(labels[alone])) == 19
    assert merge_lights(positions, responses, None, 0.0, 0.0).max() == 0
    assert merge_lights(positions, np.zeros_like(responses), None, *default_weights(0.0, 0.0)).max() == 0
    for w1, w2 in ((-1.0, 0.0), (0.0, np.inf), (np.nan, 0.0)):
        with pytest.raises(ValueError, match="weights"):
            merge_lights(positions, responses, None, w1, w2)


@pytest.mark.parametrize("scale", [1e-30, 1e-18, 1e18, 1e30])
def test_the_unit_of_responses_does_not_matter(scale):
    positions, responses = problem(50, 300, 3)
    w1, w2 = default_weights(3 ** 0.5, largest_response(responses), 0.5, 0.2)
    scaled = (responses.astype(float) * scale).astype(np.float32)
    w3 = default_weights(3 ** 0.5, largest_response(scaled), 0.5, 0.2)[1]
    assert w3 * scale == pytest.approx(w2, rel=1e-5)
    assert np.allclose(light_distances(positions, scaled, w1, w3), light_distances(positions, responses, w1, w2),
                       rtol=1e-4)


def test_no_lights_one_light_no_receivers_and_broken_responses():
    assert merge_lights(np.zeros((0, 3)), np.zeros((5, 0, 1), np.float32), None, 1.0, 1.0).tolist() == []
    assert merge_lights(np.zeros((1, 3)), np.zeros((5, 1, 1), np.float32), None, 1.0, 1.0).tolist() == [0]
    positions, responses = problem(10, 0, 1)
    assert merge_lights(positions, responses, None, 0.1, 5.0).max() == 0
    positions, responses = problem(10, 30, 2)
    responses[4, 6, 1] = np.nan
    with pytest.raises(ValueError, match="light 6"):
        merge_lights(positions, responses, None, 0.1, 0.1)
    with pytest.raises(ValueError, match="shape"):
        light_distances(positions[:5], responses, 1.0, 1.0)
    assert np.all(light_distances(positions, responses[:, :, :1], 1e9, 1.0) == FAR)


def test_responses_may_lie_on_disk(tmp_path):
    positions, responses = problem(40, 700, 2)
    stored = np.lib.format.open_memmap(tmp_path / "responses.npy", "w+", np.float32, responses.shape)
    stored[:] = responses
    assert np.array_equal(light_distances(positions, stored, 1.0, 1.0), light_distances(positions, responses, 1.0, 1.0))
    labels = merge_lights(positions, stored, None, 1.0, 1.0)
    assert np.array_equal(merged_response(stored, labels, "harmonic"), merged_response(responses, labels, "harmonic"))


LABELS = np.array([0, 1, 0, 2, 1, 0])


def test_means_of_positive_responses_are_the_plain_ones(monkeypatch):
    monkeypatch.setattr(light_clustering, "BLOCK_NUMBERS", 50)
    responses = np.random.default_rng(1).uniform(0.5, 1.9, (30, 6, 3)).astype(np.float32)
    for mode, mean in (("harmonic", hmean), ("arithmetic", np.mean)):
        found = merged_response(responses, LABELS, mode, channels=3)
        expected = np.stack([mean(responses[:, c == LABELS], axis=1) for c in range(3)], axis=1)
        assert found.dtype == np.float32 and np.allclose(found, expected, rtol=1e-5)


def test_harmonic_mean_of_zeros_and_of_both_signs():
    rng = np.random.default_rng(2)
    responses = rng.normal(size=(500, 6, 1)).astype(np.float32)
    responses[rng.random(responses.shape) < 0.3] = 0.0
    found = merged_response(responses, LABELS, "harmonic")
    mean = merged_response(responses, LABELS, "arithmetic")
    assert np.isfinite(found).all() and (np.abs(found) <= np.abs(mean) * (1 + 1e-5)).all()
    assert (found * mean >= 0).all() and not found[:, 1][(responses[:, [1, 4]] == 0).all(axis=1)[:, 0]].any()
    assert np.allclose(merged_response(-responses, LABELS, "harmonic"), -found)
    one_dark = np.array([[[0.0], [1.0], [1.0], [1.0]]], np.float32)
    assert 0.5 < merged_response(one_dark, np.zeros(4, int), "harmonic")[0, 0, 0] < 0.75
    steps = np.linspace(-0.5, 1.5, 2001, dtype=np.float32)  # one light fades through zero: no jump
    ramp = np.stack([steps, np.ones_like(steps)], axis=1)[:, :, None]
    assert np.abs(np.diff(merged_response(ramp, np.zeros(2, int), "harmonic")[:, 0, 0])).max() < 2e-3


def test_harmonic_mean_of_matrices_keeps_each_channels_direction():
    rng = np.random.default_rng(3)
    rows, lengths = rng.normal(size=4), np.array([[1.0, 2.0, 3.0], [2.0, 1.0, 1.5]])
    rows /= np.linalg.norm(rows)
    responses = (rows[None, :, None] * lengths[:, None, :]).reshape(1, 2, 12).astype(np.float32)
    found = merged_response(responses, np.zeros(2, int), "harmonic", channels=3)
    assert np.allclose(found.reshape(4, 3), rows[:, None] * hmean(lengths, axis=0), rtol=1e-5)
    with pytest.raises(ValueError, match="mean"):
        merged_response(responses, np.zeros(2, int), "geometric")


def test_merged_lights_stand_at_the_mean_unless_something_is_in_the_way():
    pillar = join("pillar", box(inward=True), box(low=(0.4, 0.4, 0), high=(0.6, 0.6, 1)))
    tracer = Tracer(pillar.positions, pillar.triangles, 1)
    angles = np.arange(8) * np.pi / 4
    ring = np.stack([0.5 + 0.35 * np.cos(angles), 0.52 + 0.35 * np.sin(angles), np.full(8, 0.5)], axis=1)
    corner = np.array([[0.1, 0.1, 0.1], [0.2, 0.1, 0.1]])
    labels = np.repeat([0, 1], [8, 2])
    found = merged_positions(tracer, np.concatenate([ring, corner]), labels)
    assert np.allclose(found[1], [0.15, 0.1, 0.1])
    assert (found[0] == ring).all(axis=1).any()
