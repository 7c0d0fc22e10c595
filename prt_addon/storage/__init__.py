# SPDX-License-Identifier: GPL-3.0-or-later
"""The versioned container of baked transfer, its digests and its files. One format for every kind of transfer."""
