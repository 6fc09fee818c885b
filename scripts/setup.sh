#!/usr/bin/env bash
# Everything velap needs on a fresh Debian or Ubuntu machine: Python, a virtual environment in .venv, the packages of
# constraints.txt, a software OpenGL and a C compiler. Safe to repeat; a second run does nothing unless pyproject.toml or constraints.txt changed.
set -euo pipefail
cd "$(dirname "$0")/.."

stamp=.venv/.velap-setup
wanted=$(cat pyproject.toml constraints.txt scripts/setup.sh | sha256sum)
[ -f "$stamp" ] && [ "$(cat "$stamp")" = "$wanted" ] && exit 0

say() { printf '\n==> %s\n' "$*"; }

# Installs system packages as root; prints the command and stops otherwise.
system_packages() {
    if [ "$(id -u)" -eq 0 ] && command -v apt-get >/dev/null; then
        say "installing $*"
        apt-get update -qq
        DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends "$@"
    else
        printf '\nSystem packages are missing. Run this, then repeat the same make command:\n\n    sudo apt-get install -y %s\n\n' "$*" >&2
        exit 1
    fi
}

new_enough() { "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; }

find_python() {
    local candidate
    for candidate in ${PYTHON:-} python3 python3.13 python3.12 python3.11; do
        if command -v "$candidate" >/dev/null && new_enough "$candidate"; then
            echo "$candidate"
            return
        fi
    done
    return 1
}

# A venv without pip (Debian ships ensurepip apart) or of an old Python is made anew.
if ! new_enough .venv/bin/python || ! .venv/bin/python -m pip --version >/dev/null 2>&1; then
    python=$(find_python) || {
        if command -v python3 >/dev/null; then packages="python3.11 python3.11-venv"; else packages="python3 python3-venv"; fi
        system_packages $packages
        python=$(find_python) || { echo "velap needs Python 3.11 or newer; name one with PYTHON=/path/to/python3 make ..." >&2; exit 1; }
    }
    if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        system_packages "python$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')-venv"
    fi
    say "virtual environment .venv with $("$python" --version)"
    "$python" -m venv --clear .venv
fi

say "Python packages (PyTorch is large, this can take minutes)"
export PIP_DISABLE_PIP_VERSION_CHECK=1
.venv/bin/python -m pip install --quiet torch==2.13.0
.venv/bin/python -m pip install --quiet -c constraints.txt -e '.[dev]'
# openpi-client asks for NumPy 1 and needs none of its other packages: the tests of `velap serve` take it as it is.
.venv/bin/python -m pip install --quiet --no-deps openpi-client==0.1.2

# The real thing is drawn: libraries that are there and do not work count as missing.
draws() { .venv/bin/python -c 'import gymnasium, velap.envs; gymnasium.make("velap/SpiralMaze-v0").reset(seed=0)'; }
if ! draws >/dev/null 2>&1; then
    system_packages libegl1 libgl1-mesa-dri
    draws || { echo "velap still cannot draw; the lines above say why." >&2; exit 1; }
fi

# Plans are twice as fast with velap's C code, which is built at first use.
command -v cc >/dev/null || command -v gcc >/dev/null || command -v clang >/dev/null || system_packages gcc libc6-dev

echo "$wanted" > "$stamp"
say "ready"
