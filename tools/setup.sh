#!/usr/bin/env bash
# Makes everything that the project needs, in .venv of this checkout. Safe to run at any time: a finished
# set-up is recognised by its stamp, which is written last, and an interrupted one is resumed.
#   PYTHON=/path/to/python   the interpreter to build .venv from (default: the first of python3.11,
#                            python3.12, python3 that fits)
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

venv=.venv
python=$venv/bin/python
stamp=$venv/preface-setup.stamp
# The last release that ships its models. Its metadata asks for numpy<2, jax and the GUI build of OpenCV,
# none of which its face and segmentation solutions use: hence --no-deps.
mediapipe=mediapipe==0.10.21
opencv_wheel=opencv-contrib-python-headless

say() { printf 'setup: %s\n' "$*"; }
fail() { printf 'setup: error: %s\n' "$*" >&2; exit 1; }

# step "what happens" command...: one progress line with the time that the command took.
step() {
    local title=$1 start=$SECONDS
    shift
    printf 'setup: %s ... ' "$title"
    "$@" </dev/null || { echo failed; fail "'$*' failed; nothing is lost, run tools/setup.sh again to resume"; }
    printf '%d s\n' $((SECONDS - start))
}

# The checkout's path is part of the fingerprint because console scripts and the editable install hold it.
fingerprint() {
    { pwd; cat requirements.lock pyproject.toml tools/setup.sh; } | sha256sum | cut -d' ' -f1
}

pip() {
    "$python" -m pip "$@" -qq --disable-pip-version-check --no-input
}

fits() { # a python that mediapipe's wheels support
    "$1" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))' 2>/dev/null
}

find_python() {
    local candidate candidates=(python3.11 python3.12 python3)
    [ -z "${PYTHON:-}" ] || candidates=("$PYTHON")
    for candidate in "${candidates[@]}"; do
        if fits "$candidate"; then
            command -v "$candidate"
            return
        fi
    done
    fail "needs Python 3.11 or 3.12; tried: ${candidates[*]}." \
        "Install one, or name it: PYTHON=/path/to/python3.11 bash tools/setup.sh"
}

# Debian packages that are missing, one per line: libraries that open3d and torch load, and python's venv.
missing_packages() {
    [ "$(uname -s)" = Linux ] || return 0
    "$1" - <<'PY'
import ctypes, importlib.util
LIBRARIES = {
    "libEGL.so.1": "libegl1", "libGL.so.1": "libgl1", "libX11.so.6": "libx11-6", "libusb-1.0.so.0": "libusb-1.0-0",
    "libudev.so.1": "libudev1", "libidn2.so.0": "libidn2-0", "libgomp.so.1": "libgomp1",
}
for soname, package in LIBRARIES.items():
    try:
        ctypes.CDLL(soname)
    except OSError:
        print(package)
if importlib.util.find_spec("ensurepip") is None:
    print("python3-venv")
PY
}

install_packages() {
    local apt=(env DEBIAN_FRONTEND=noninteractive apt-get -qq)
    [ "$(id -u)" = 0 ] || apt=(sudo -n "${apt[@]}")
    "${apt[@]}" update || return
    "${apt[@]}" install -y --no-install-recommends "$@" >/dev/null
}

require_packages() { # installs what is missing, or says how to
    [ $# -gt 0 ] || return 0
    command -v apt-get >/dev/null ||
        fail "missing system packages (Debian's names): $*. Install them with this system's package manager"
    [ "$(id -u)" = 0 ] || sudo -n true 2>/dev/null ||
        fail "missing system packages; run: sudo apt-get install -y $* && bash tools/setup.sh"
    step "installing system packages ($*)" install_packages "$@"
}

# The OpenCV wheels share one folder and overwrite each other, so a stray one takes ours down with it.
remove_stray_opencv() {
    local installed strays
    installed=$("$python" -m pip list --format=freeze --disable-pip-version-check 2>/dev/null)
    strays=$(grep -oiE '^opencv[a-z-]*' <<<"$installed" | grep -vx "$opencv_wheel" || true)
    [ -n "$strays" ] || return 0
    # shellcheck disable=SC2086  # one word per wheel
    step "removing OpenCV wheels that collide ($(xargs <<<"$strays"))" pip uninstall -y $strays "$opencv_wheel"
}

lpips_weights() { # without the paths that it prints
    "$python" -m preface.model.metrics.lpips_weights >/dev/null
}

exit_if_ready() {
    if [ -x "$python" ] && [ -f "$stamp" ] && [ "$(cat "$stamp")" = "$(fingerprint)" ]; then
        say "ready ($venv)"
        exit 0
    fi
}

exit_if_ready
if command -v flock >/dev/null; then # two set-ups at a time would install into each other
    exec 9<requirements.lock
    flock -n 9 || { say "waiting for another set-up of this checkout"; flock 9; exit_if_ready; }
fi

if [ -x "$python" ]; then
    fits "$python" || fail "$venv holds another Python than 3.11 or 3.12; remove $venv and run tools/setup.sh again"
    base=$python
else
    base=$(find_python)
fi
packages=$(missing_packages "$base")
# shellcheck disable=SC2086  # one word per package
require_packages $packages

if ! "$python" -m pip --version >/dev/null 2>&1; then # absent, or left half made
    step "making $venv from $base" "$base" -m venv "$venv"
fi
rm -f "$stamp"

torch=$(grep -E '^torch==' requirements.lock) || fail "requirements.lock has no line 'torch==...'"
step "installing $torch (the largest download)" pip install "$torch"
remove_stray_opencv
step "installing $(grep -cE '^[^#]+==' requirements.lock) locked packages" pip install --no-deps -r requirements.lock
step "installing $mediapipe" pip install --no-deps "$mediapipe"
step "installing preface, editable" pip install --no-deps --no-build-isolation --editable .
say "checking that everything imports in one process"
"$python" tools/check_environment.py || fail "the environment does not fit together; see above"

step "fetching the weights of LPIPS (64 MB, once per user)" lpips_weights

# Minutes on the first start of a machine, a second afterwards; better here than in the middle of a test.
step "reading the parametric head (slow the first time on a machine)" \
    env PYTHONPATH=tools "$python" -c 'from synthetic_studio.template import head_template; head_template()'

fingerprint >"$stamp.new"
mv "$stamp.new" "$stamp"
say "ready ($venv) after $SECONDS s"
