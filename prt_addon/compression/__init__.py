# SPDX-License-Identifier: GPL-3.0-or-later
"""Clustered principal component analysis of a surface signal (Sloan et al. 2003, sections 4 and 5).

Rule: knows nothing of surfaces, light or colours; a signal is points x values. `encoding.encode` is the one entrance.
Reading order: settings, monitor, global_frame, subspaces, pca, vector_quantization, seeding, reclassify, neighbours,
rebalancing, clustered_pca, adaptive, encoding, coherence.
"""
