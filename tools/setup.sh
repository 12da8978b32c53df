#!/usr/bin/env bash
# Makes or updates a virtual environment with this checkout in it (editable).
#
#   tools/setup.sh VENV EXTRAS [PIP-OPTION...]      e.g. tools/setup.sh .venv all,test
#
# Environment: PYTHON (python3) makes the virtual environment, TORCH (torch==2.13.0) is installed first.
set -euo pipefail
cd "$(dirname "$0")/.."
[ $# -ge 2 ] || { echo "usage: $0 VENV EXTRAS [PIP-OPTION...]" >&2; exit 2; }
venv=$1 extras=$2
shift 2
python=${PYTHON:-python3}
# First and pinned, also while the rest resolves: any other choice of pip's costs gigabytes of CUDA.
torch=${TORCH:-torch==2.13.0}

say() { echo "[setup] $*"; }
die() { echo "[setup] error: $*" >&2; exit 1; }
pip() { "$venv/bin/python" -m pip --no-input --disable-pip-version-check "$@"; }

if ! "$venv/bin/python" -m pip --version >/dev/null 2>&1; then
  command -v "$python" >/dev/null || die "no $python: install Python 3.11 or newer, or set PYTHON=/path/to/python"
  "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
    || die "$("$python" --version) is too old: seal_gym needs 3.11 or newer (set PYTHON=/path/to/python)"
  "$python" -c 'import ensurepip, venv' 2>/dev/null \
    || die "$python has no venv module: apt-get install python3-venv (Debian, Ubuntu)"
  say "virtual environment $venv ($("$python" --version))"
  rm -rf "$venv"
  "$python" -m venv "$venv"
fi
pip install -qq --upgrade pip
say "$torch"
pip install -qq "$torch"
say "seal-gym[$extras] (a few minutes the first time)"
pip install -qq "$@" "$torch" -e ".[$extras]"

bash tools/gl.sh "$venv/bin/python"

if [ -e seal_gym/warmup.py ] || [ -d seal_gym/warmup ]; then
  say "compiling the kernels (once)"
  MUJOCO_GL=disabled "$venv/bin/python" -m seal_gym.warmup
fi
