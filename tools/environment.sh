#!/bin/sh
# SPDX-License-Identifier: GPL-3.0-or-later
# Makes .venv from requirements/NAME.txt (runtime or test) and prints the path of its Python. A second call with
# unchanged requirements costs nothing; everything is checked against its hash.
set -eu
name=${1:?runtime or test}
root=$(cd "$(dirname "$0")/.." && pwd)
environment=$root/.venv
python=$environment/bin/python
"$root/tools/system_libraries.sh"

stamp=$environment/.installed
# The tests' requirements contain the commands' own: where they are installed, `runtime` is satisfied too.
if [ -x "$python" ] && [ -e "$stamp" ] && "$python" -c '' 2>/dev/null &&
    { cmp -s "$stamp" "$root/requirements/$name.txt" ||
        { [ "$name" = runtime ] && cmp -s "$stamp" "$root/requirements/test.txt"; }; }; then
    echo "$python"
    exit 0
fi
interpreter=$("$root/tools/find_python")
echo "installing requirements/$name.txt with $("$interpreter" --version) into .venv (about 450 MB to download the first time)" >&2
[ -x "$python" ] && "$python" -c '' 2>/dev/null || { rm -rf "$environment" && "$interpreter" -m venv "$environment" >&2; }
"$python" -m pip install --quiet --disable-pip-version-check --only-binary=:all: --require-hashes \
    -r "$root/requirements/$name.txt" >&2
cp "$root/requirements/$name.txt" "$stamp"
echo "$python"
