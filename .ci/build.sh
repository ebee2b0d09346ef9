#!/usr/bin/env bash
# Builds sdist and wheel, and a wheel of each guest, into dist/ and uses them as a stranger would: .ci/build.sh VENV.
# The stranger has an environment of their own, an empty folder, and no checkout.
set -euo pipefail
cd "$(dirname "$0")/.."
readonly top=$PWD venv=$1
empty=$(mktemp -d)
trap 'rm -rf "$empty"' EXIT

rm -rf dist
"$venv/bin/uv" build -q --python "$venv/bin/python" --no-build-isolation --out-dir dist
for guest in agents/guests/*/; do
    "$venv/bin/uv" build -q --wheel --python "$venv/bin/python" --no-build-isolation --out-dir dist "$guest"
done
PYTHON="$top/$venv/bin/python" .ci/setup.sh "$empty/venv" "$top"/dist/*.whl
mkdir "$empty/folder" && cd "$empty/folder"
"$empty/venv/bin/imagine-bench" describe >/dev/null
"$empty/venv/bin/imagine-bench" doctor
"$empty/venv/bin/imagine-bench" bench --task arrow_puzzle --preset smoke --agents random dqn oracle q_learning
ls "$top"/dist/*
