#!/bin/sh
# SPDX-License-Identifier: GPL-3.0-or-later
# The wheel `bpy` is Blender: on Linux it links against X11 and OpenGL even without a window, and the GPU module
# needs EGL with a driver (Mesa's software driver will do). Installs what is missing where apt-get and root are at hand,
# else names it. Exit code 0: nothing is missing.
set -eu
[ "$(uname -s)" = Linux ] || exit 0

# Library and the Debian/Ubuntu package that brings it; `ldd` on bpy's module in a bare system named them.
needed='libX11.so.6 libx11-6
libXrender.so.1 libxrender1
libXfixes.so.3 libxfixes3
libXi.so.6 libxi6
libXext.so.6 libxext6
libXt.so.6 libxt6
libxkbcommon.so.0 libxkbcommon0
libSM.so.6 libsm6
libICE.so.6 libice6
libGL.so.1 libgl1
libEGL.so.1 libegl1
libEGL_mesa.so.0 libegl-mesa0'

known=$(PATH="$PATH:/sbin:/usr/sbin" ldconfig -p)
libraries= packages=
old_ifs=$IFS
IFS='
'
for line in $needed; do
    library=${line%% *}
    case $known in
    *"$library"*) ;;
    *)
        libraries="$libraries $library"
        packages="$packages ${line##* }"
        ;;
    esac
done
IFS=$old_ifs
# Mesa's drivers are loaded by name from their own folder: not in ldconfig's list.
if ! ls /usr/lib*/*/dri/swrast_dri.so /usr/lib*/dri/swrast_dri.so /usr/lib*/*/libgallium*.so /usr/lib*/libgallium*.so 2>/dev/null |
    grep -q .; then
    libraries="$libraries swrast_dri.so"
    packages="$packages libgl1-mesa-dri"
fi
[ -n "$libraries" ] || exit 0

echo "system libraries missing:$libraries" >&2
if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    echo "installing:$packages" >&2
    export DEBIAN_FRONTEND=noninteractive
    apt-get update -qq >&2
    # shellcheck disable=SC2086 # a list of package names
    apt-get install -y -qq --no-install-recommends $packages >&2
    exit 0
fi
echo "install them first; on Debian or Ubuntu: sudo apt-get install$packages" >&2
exit 1
