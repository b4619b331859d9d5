#!/bin/sh
# Make sure that the shared libraries which Open3D and its offscreen renderer load are there.
# As root on Debian they are installed; otherwise one message says what to install.
set -eu

packages=""
need() { # need LIBRARY PACKAGE
    ldconfig -p 2>/dev/null | grep -q "$1" || packages="$packages $2"
}
need 'libusb-1.0\.so\.0' libusb-1.0-0
need 'libGL\.so\.1' libgl1
need 'libEGL\.so\.1' libegl1
need 'libgomp\.so\.1' libgomp1
need 'libX11\.so\.6' libx11-6
need 'libEGL_mesa\.so\.0' libegl-mesa0
need 'libxcb\.so\.1' libxcb1
[ -e /usr/lib/"$(uname -m)"-linux-gnu/dri/swrast_dri.so ] || packages="$packages libgl1-mesa-dri"
"${PYTHON:-python3}" -c 'import ensurepip' 2>/dev/null || packages="$packages python3-venv"
[ -n "$packages" ] || exit 0

if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    echo "installing system packages:$packages"
    export DEBIAN_FRONTEND=noninteractive
    apt-get update -qq
    # shellcheck disable=SC2086
    apt-get install -y -qq --no-install-recommends $packages >/dev/null
else
    echo "geomocap: missing system packages; install them first: sudo apt-get install$packages" >&2
    exit 1
fi
