#!/bin/sh
# The Debian/Ubuntu packages that pip cannot bring: offscreen OpenGL for the simulated lab, and LLVM for the attacks on meshes.
# Without root, or on another system, it says what is missing and goes on: nothing else needs them.
#   system-packages.sh [demo]    demo: only what the demo needs, so no LLVM
set -eu

has() { ldconfig -p 2>/dev/null | grep -qE "$1"; }

packages=""
# mujoco's offscreen context needs EGL, Mesa's software driver behind it, and the OpenGL entry points.
if ! has 'libEGL_mesa.so.0' || ! has 'libOpenGL.so.0|libGL.so.1'; then
  packages="libegl1 libgl1-mesa-dri libegl-mesa0 libopengl0"
fi
# Mitsuba compiles its kernels with LLVM; 15 and 16 crash on processors with AVX-512. Older systems do not have it.
if [ "${1:-}" != demo ] && ! has 'libLLVM(-|\.so\.)(1[7-9]|2[0-9])'; then
  if ! command -v apt-cache >/dev/null 2>&1 || apt-cache show libllvm19 >/dev/null 2>&1 || [ "$(id -u)" -eq 0 ]; then
    packages="$packages libllvm19"
  fi
fi
[ -n "$packages" ] || exit 0

if ! command -v apt-get >/dev/null 2>&1; then
  echo "not found: $packages. This is not a Debian system: install Mesa's EGL (simulated lab) and LLVM 17 or newer (meshes) with your package manager." >&2
  exit 0
fi
if [ "$(id -u)" -ne 0 ]; then
  echo "not found: run 'sudo apt-get install $packages' before using the simulated lab (EGL) or attacking meshes (LLVM)." >&2
  exit 0
fi
apt-get update -qq
for package in $packages; do
  if ! apt-cache show "$package" >/dev/null 2>&1; then
    echo "this system has no package $package; what needs it will say so" >&2
    continue
  fi
  echo "installing $package"
  DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$package" >/dev/null
done
