#!/usr/bin/env bash
# Installs the project into its own virtual environment: .ci/setup.sh [VENV [WHEEL...]]. Every make target calls it first;
# where nothing changed it ends at once. It repairs an environment that was moved, interrupted or whose Python is gone.
#
# PYTHON names the interpreter, 3.11 to 3.14. Without it python3, python3.14 to python3.11 and one of uv's are tried in
# turn. TORCH_INDEX names an index of torch's CPU builds, for machines without an NVIDIA GPU that cannot reach PyTorch's.
# Versions and hashes are in .ci/requirements.lock ('make lock' writes it). uv is used where it can be had, else pip.
set -euo pipefail
cd "$(dirname "$0")/.."

readonly venv=${1:-.venv}
project=(-e .)
for guest in agents/guests/*/; do project+=(-e "$guest"); done
[ $# -lt 2 ] || project=("${@:2}")
readonly project
readonly lock=.ci/requirements.lock
readonly versions="3.11 3.12 3.13 3.14"
readonly torch=2.13.0
readonly gl_packages="libegl1 libgl1-mesa-dri"
system=$(uname -s)
log=$(mktemp)
why=""    # why the last thing that was tried did not work
tried=""  # interpreters that did not work and why, one a line
trap 'rm -f "$log"' EXIT
trap 'exit 130' INT TERM

# the absolute path of the environment, which its scripts hold
case $venv in /*) here=$venv ;; *) here=$PWD/$venv ;; esac
PATH=:$PATH: PATH=${PATH//":$here/bin:"/:} PATH=${PATH#:} PATH=${PATH%:}  # it must not be made anew with its own Python

fail() { printf 'setup: %s\n' "$*" >&2; exit 1; }
say() { printf 'setup: %s\n' "$*"; }

root_on_debian() { [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; }

apt_install() {
    export DEBIAN_FRONTEND=noninteractive
    apt-get install -y -qq --no-install-recommends "$@" >/dev/null 2>&1 && return
    apt-get update -qq && apt-get install -y -qq --no-install-recommends "$@" >/dev/null
}

# Whether an interpreter runs and has a version that works; sets found to the version, or why.
suits() {
    command -v "$1" >/dev/null || { why="not found"; return 1; }
    found=$("$1" -c 'import sys; print("%d.%d.%d" % sys.version_info[:3])' 2>"$log") || {
        why="does not run: $(head -n 1 "$log")"
        return 1
    }
    case " $versions " in *" ${found%.*} "*) return 0 ;; esac
    why="is Python $found, needed is one of $versions"
    return 1
}

asked_for() {
    local version=$found
    [ -n "${PYTHON:-}" ] || return 0
    suits "$PYTHON" && [ "$found" = "$version" ] && return
    why="PYTHON asks for another Python than its $version"
    return 1
}

# Whether the environment was installed to the end and still runs; sets why.
whole() {
    [ -f "$venv/.installed" ] || { why="an installation in it did not finish"; return 1; }
    suits "$venv/bin/python" || { why="its Python $why"; return 1; }
    asked_for || return 1
    "$venv/bin/python" -m pip --version >/dev/null 2>&1 || { why="it has no pip"; return 1; }
}

# Scripts of a moved environment hold its old path in their first lines.
relocate() {
    say "$venv was moved; repairing it"
    "$venv/bin/python" - "$(cat "$venv/.installed")" "$here" "$venv"/bin/* <<'PYTHON'
import sys
from pathlib import Path
old, new = (path.encode() for path in sys.argv[1:3])
for script in map(Path, sys.argv[3:]):
    content = b"\0" if script.is_symlink() or not script.is_file() else script.read_bytes()
    if b"\0" not in content:
        script.write_bytes(content.replace(old, new))
PYTHON
}

make_venv() {
    "$1" -m venv --clear "$venv" >"$log" 2>&1 && return
    if root_on_debian && { apt_install "python${found%.*}-venv" || apt_install python3-venv; } 2>/dev/null; then
        "$1" -m venv --clear "$venv" >"$log" 2>&1 && return
    fi
    if command -v uv >/dev/null; then uv venv -q --seed --clear --python "$1" "$venv" 2>>"$log" && return; fi
    why="cannot make a virtual environment: $(tail -n 1 "$log") (Debian and Ubuntu: apt-get install python3-venv)"
    return 1
}

pip_install() { "$venv/bin/python" -m pip install -qq --disable-pip-version-check --retries 1 "$@"; }

# uv installs in seconds what takes pip a minute. It reads none of pip's settings, so pip may find a package that uv cannot.
# Where Python may not write bytecode, the packages are compiled now: otherwise each process compiles torch again.
install() {
    local uv compile=()
    [ -z "${PYTHONDONTWRITEBYTECODE:-}" ] || compile=(--compile-bytecode)
    if uv=$(command -v uv || command -v "$here/bin/uv"); then
        UV_FIND_LINKS=${UV_FIND_LINKS:-${PIP_FIND_LINKS:-}} "$uv" pip install -q ${compile[@]+"${compile[@]}"} --python "$venv/bin/python" "$@" && return
    fi
    pip_install "$@"
}

get_uv() {
    command -v uv >/dev/null || [ -x "$venv/bin/uv" ] && return
    awk '/^uv==/ { on = 1 } on { print } on && !/\\$/ { exit }' "$lock" >"$log"
    pip_install --no-deps --require-hashes -r "$log" 2>/dev/null || say "uv is out of reach; pip takes a few minutes instead"
}

install_torch() {
    if [ "$system" = Linux ] && ! nvidia-smi -L >/dev/null 2>&1; then
        install --no-deps "torch==$torch+cpu" 2>/dev/null && return
        [ -z "${TORCH_INDEX:-}" ] || { install --no-deps --extra-index-url "$TORCH_INDEX" "torch==$torch+cpu" && return; }
        # uv knows PyTorch's own index; pip refuses the option
        UV_HTTP_TIMEOUT=15 UV_HTTP_RETRIES=0 install --no-deps --torch-backend cpu "torch==$torch+cpu" 2>/dev/null && return
        say "no CPU build of torch within reach; taking the plain one (several GB). TORCH_INDEX can name a CPU index."
    fi
    install "torch==$torch"
}

# Fills the environment; sets why. One that was whole counts as whole again if nothing could be fetched.
fill() {
    local before
    before=$(cat "$venv/.installed" 2>/dev/null) || true
    rm -f "$venv/.installed" "$venv/.ready"
    if install_all; then
        printf '%s\n' "$here" >"$venv/.installed"
    else
        [ -z "$before" ] || printf '%s\n' "$here" >"$venv/.installed"
        return 1
    fi
}

install_all() {
    local problems
    get_uv
    install --no-deps --require-hashes -r "$lock" || { why="the packages of $lock could not be installed; see above"; return 1; }
    install_torch || { why="torch $torch could not be installed; see above"; return 1; }
    install --no-deps --no-build-isolation "${project[@]}" || { why="the project itself could not be installed; see above"; return 1; }
    problems=$("$venv/bin/python" -m pip check 2>&1 | grep '^imagine-bench') || true
    [ -z "$problems" ] || { why="$problems; $lock is out of date, run 'make lock'"; return 1; }
}

# Makes and fills the environment with the first interpreter that can, uv's as the last.
choose_python() {
    local name failed="" names=(python3 python3.14 python3.13 python3.12 python3.11)
    [ -z "${PYTHON:-}" ] || names=("$PYTHON")
    for name in "${names[@]}"; do
        if suits "$name"; then
            case " $failed " in *" $found "*) continue ;; esac  # the same version under another name
            make_venv "$name" && { fill && return; failed="$failed $found"; }
            name="$name ($found)"
        fi
        tried="$tried"$'\n'"  $name: $why"
        [ "$why" = "not found" ] || say "not $name: $why"
    done
    [ -z "${PYTHON:-}" ] || fail "PYTHON=$PYTHON cannot be used:$tried"
    if ! command -v uv >/dev/null; then
        why="not found"
    elif uv venv -q --seed --clear --python 3.12 "$venv" 2>"$log"; then
        fill && return
    else
        why="cannot get Python 3.12: $(tail -n 1 "$log")"
    fi
    fail "no Python could be used. Tried:$tried"$'\n'"  uv: $why"$'\n'"Install one of Python $versions and run PYTHON=/its/path make setup."
}

gl_problem() {
    "$venv/bin/python" -P - 2>&1 <<'PYTHON'
import sys
from imagine_bench.errors import SetupError
from imagine_bench.tasks.rendering import gl_renderer
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

key="$(cat pyproject.toml agents/guests/*/pyproject.toml "$lock" .ci/setup.sh | cksum) $here"
if [ "$(cat "$venv/.ready" 2>/dev/null)" = "$key" ] && [ -x "$venv/bin/python" ] && [ -z "${PYTHON:-}" ]; then exit 0; fi
if [ ! -e "$venv" ]; then
    say "installing into $venv (once; about a minute)"
    choose_python
elif whole; then
    if [ "$(cat "$venv/.ready" 2>/dev/null)" = "$key" ]; then exit 0; fi
    [ "$(cat "$venv/.installed")" = "$here" ] || relocate
    say "bringing $venv up to date"
    fill || fail "$why. (Without $venv the same command makes it anew.)"
else
    say "making $venv anew: $why"
    choose_python
fi
check_gl
printf '%s\n' "$key" >"$venv/.ready"
say "ready"
