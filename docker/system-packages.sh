#!/bin/sh
# The Debian/Ubuntu packages that pip cannot bring: offscreen OpenGL for the simulated lab.
# Without root, or on another system, it says what is missing and goes on: only the twin needs them.
set -eu

packages="libegl1 libgl1-mesa-dri libegl-mesa0 libopengl0"

# mujoco's offscreen context needs EGL, Mesa's software driver behind it, and the OpenGL entry points.
if ldconfig -p 2>/dev/null | grep -q 'libEGL_mesa.so.0' && ldconfig -p | grep -qE 'libOpenGL.so.0|libGL.so.1'; then
  exit 0
fi
if ! command -v apt-get >/dev/null 2>&1; then
  echo "libEGL was not found and this is not a Debian system: install Mesa's EGL with your package manager." >&2
  exit 0
fi
if [ "$(id -u)" -ne 0 ]; then
  echo "libEGL was not found: run 'sudo apt-get install $packages' before using the simulated lab." >&2
  exit 0
fi
echo "installing $packages"
apt-get update -qq
DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $packages >/dev/null
