#!/usr/bin/env bash
# Installs the project into its own virtual environment: .ci/setup.sh VENV STAMP. 'make setup' calls it; again it is instant.
#
# PYTHON names the interpreter (3.11 to 3.13), TORCH_INDEX the index of torch's CPU builds (PyTorch's install page has
# it) for machines without an NVIDIA GPU whose package index offers no '+cpu' build. uv is used where it is installed.
set -euo pipefail

readonly venv=$1 stamp=$2
readonly torch=2.13.0
readonly gl_packages="libegl1 libgl1-mesa-dri"
readonly system=$(uname -s)

fail() { printf 'setup: %s\n' "$*" >&2; exit 1; }
say() { printf 'setup: %s\n' "$*"; }

suits() {
    "$1" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null
}

find_python() {
    local name
    for name in ${PYTHON:-python3 python3.13 python3.12 python3.11}; do
        if command -v "$name" >/dev/null && suits "$name"; then command -v "$name"; return; fi
    done
    return 1
}

root_on_debian() { [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; }

apt_install() {
    export DEBIAN_FRONTEND=noninteractive
    apt-get install -y -qq --no-install-recommends "$@" >/dev/null 2>&1 && return
    apt-get update -qq && apt-get install -y -qq --no-install-recommends "$@" >/dev/null
}

make_venv() {
    local python
    if [ -x "$venv/bin/python" ] && suits "$venv/bin/python"; then
        "$venv/bin/python" -m pip --version >/dev/null 2>&1 && return
        "$venv/bin/python" -m ensurepip >/dev/null 2>&1 && return  # uv makes environments without pip
    fi
    [ ! -d "$venv" ] || say "replacing $venv, whose Python is none of 3.11 to 3.13 or cannot install anything"
    if python=$(find_python); then
        "$python" -m venv --clear "$venv" >/dev/null 2>&1 && return
        root_on_debian || fail "$python cannot make a virtual environment; on Debian or Ubuntu: apt-get install python3-venv."
        apt_install "$(basename "$(readlink -f "$python")")-venv" || apt_install python3-venv
        "$python" -m venv --clear "$venv"
    elif command -v uv >/dev/null; then
        uv venv -q --seed --clear --python 3.12 "$venv"
    else
        fail "Python 3.11, 3.12 or 3.13 is needed and ${PYTHON:-python3} is" \
            "$("${PYTHON:-python3}" --version 2>&1 || true); install one and run PYTHON=/its/path make setup."
    fi
}

# uv installs in seconds what takes pip a minute. It reads none of pip's settings, so what it cannot find, pip may.
install() {
    local uv
    uv=$(command -v uv || command -v "$venv/bin/uv") || true
    if [ -n "$uv" ]; then
        UV_FIND_LINKS=${UV_FIND_LINKS:-${PIP_FIND_LINKS:-}} "$uv" pip install -q --python "$venv/bin/python" "$@" && return
    fi
    pip_install "$@"
}

pip_install() { "$venv/bin/python" -m pip install -qq --disable-pip-version-check --retries 1 "$@"; }

install_torch() {
    if [ "$system" = Linux ] && ! nvidia-smi -L >/dev/null 2>&1; then
        install "torch==$torch+cpu" 2>/dev/null && return
        [ -z "${TORCH_INDEX:-}" ] || { install --extra-index-url "$TORCH_INDEX" "torch==$torch+cpu" && return; }
        say "no CPU build of torch within reach; taking the plain one (several GB). TORCH_INDEX can name a CPU index."
    fi
    install "torch==$torch"
}

gl_problem() {
    "$venv/bin/python" - 2>&1 <<'PYTHON'
import sys
from imagine_bench.machine import gl_renderer
from imagine_bench.errors import SetupError
try:
    gl_renderer()
except SetupError as error:
    sys.exit(str(error))
PYTHON
}

check_gl() {
    local problem
    problem=$(gl_problem) && return
    if [ "$system" = Linux ] && root_on_debian; then
        say "installing headless OpenGL: $gl_packages"
        # shellcheck disable=SC2086
        apt_install $gl_packages || fail "apt-get could not install $gl_packages. $problem"
        problem=$(gl_problem) && return
    fi
    fail "$problem Then run the same command again."
}

key=$(cat pyproject.toml .ci/setup.sh | cksum)
if [ -f "$stamp" ] && [ "$(cat "$stamp")" = "$key" ]; then
    touch "$stamp"
    exit 0
fi
say "installing into $venv (once; about a minute)"
make_venv
command -v uv >/dev/null || pip_install uv 2>/dev/null || say "uv is out of reach; pip takes a few minutes instead"
install_torch || fail "torch $torch could not be installed; the lines above say why."
install -e '.[dev]' || fail "the dependencies could not be installed; the lines above say why."
check_gl
printf '%s\n' "$key" >"$stamp"
say "ready"
