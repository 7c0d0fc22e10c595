# SPDX-License-Identifier: GPL-3.0-or-later
"""The recipe: stages in order, their settings, job folders that resume, and the child process that runs them."""
