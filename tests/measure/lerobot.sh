#!/usr/bin/env bash
# Reads a folder of demonstrations with LeRobot, splits it, trains its ACT for 50 steps and plays one episode.
#
#   tests/measure/lerobot.sh [FOLDER]
#
# FOLDER is made by 'imagine-bench dataset ArrowPuzzleMotion --format lerobot'; without one, 12 episodes are made.
# LeRobot 0.6.1 needs Python 3.12 or newer and other versions than ours, so that it has an environment of its own,
# .venv-lerobot (PYTHON names the interpreter; about 8 GB, since its torch comes with CUDA).
set -euo pipefail
cd "$(dirname "$0")/../.."
venv=.venv-lerobot
if [ ! -f "$venv/.installed" ]; then
    "${PYTHON:-python3.12}" -m venv --clear "$venv"
    "$venv/bin/python" -m pip install -q "lerobot[dataset]==0.6.1" -e ".[data]"
    # the plug-in that collects demonstrations; its agents' libraries are left out
    "$venv/bin/python" -m pip install -q --no-deps -e agents/guests/motion
    touch "$venv/.installed"
fi
folder=${1:-datasets/ArrowPuzzleMotion-lerobot}
if [ ! -e "$folder" ]; then
    "$venv/bin/imagine-bench" dataset ArrowPuzzleMotion --policy expert --episodes 12 --format lerobot --out "$folder"
fi
HF_HUB_OFFLINE=1 "$venv/bin/python" tests/measure/lerobot_act.py "$folder"
