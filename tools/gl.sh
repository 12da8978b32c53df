#!/usr/bin/env bash
# Sees to it that MuJoCo can render pictures: installs the libraries with apt where it may, else says what to
# install. Never fails: the sensors need no GL, only pictures, videos and renderer="gl" do.
#
#   tools/gl.sh PYTHON      PYTHON has mujoco; NO_APT=1 keeps the system as it is
set -uo pipefail
python=$1
packages="libegl1 libgl1 libgl1-mesa-dri"
export MUJOCO_GL=${MUJOCO_GL:-egl}

works() { "$python" "$(dirname "$0")/gl_probe.py" >/dev/null 2>&1; }
say() { echo "[setup] $*"; }

works && exit 0

as_root=()
[ "$(id -u)" = 0 ] || as_root=(sudo -n)
if [ -n "${NO_APT:-}" ]; then
  why="NO_APT is set"
elif ! command -v apt-get >/dev/null; then
  why="no apt-get here"
elif [ "$(id -u)" != 0 ] && ! sudo -n true 2>/dev/null; then
  why="apt-get needs root"
else
  say "GL libraries for the pictures: apt-get install $packages"
  network=(-o Acquire::Retries=1 -o Acquire::http::Timeout=20 -o Acquire::https::Timeout=20 -o DPkg::Lock::Timeout=120)
  if "${as_root[@]}" apt-get "${network[@]}" update -qq >/dev/null 2>&1 \
    && "${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get "${network[@]}" install -y -qq --no-install-recommends $packages >/dev/null 2>&1; then
    works && exit 0
    why="installed, but $("$python" "$(dirname "$0")/gl_probe.py" 2>&1 >/dev/null | tail -n 1)"
  else
    why="apt-get failed"
  fi
fi
say "no OpenGL ($why): runs go on without pictures; to have them, install EGL and Mesa (Debian, Ubuntu: $packages)"
exit 0
