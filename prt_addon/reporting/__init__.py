# SPDX-License-Identifier: GPL-3.0-or-later
"""What a bake tells about itself: stage times and memory, the report file, and the page made of it."""
