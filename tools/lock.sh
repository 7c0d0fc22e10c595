#!/bin/sh
# SPDX-License-Identifier: GPL-3.0-or-later
# Writes requirements/*.txt from requirements/*.in: every version, and the sha256 of every file of it, and no address.
# Needs uv on the PATH or in $UV (a person runs this when a version changes; nothing else calls it).
set -eu
cd "$(dirname "$0")/../requirements"
for name in runtime test interpreter; do
    echo "# From $name.in by tools/lock.sh." >"$name.txt.part"
    "${UV:-uv}" pip compile --quiet --python-version 3.13 --universal --generate-hashes --no-header --no-annotate \
        --no-emit-index-url --no-emit-find-links "$name.in" >>"$name.txt.part"
    mv "$name.txt.part" "$name.txt"
done
