#!/usr/bin/env bash
# Tries the real clients of MCP and OpenEnv on a server:   clients.sh ADDRESS FOLDER
#
# ADDRESS is such as http://127.0.0.1:8765. The packages need other versions than ours, so that each has an environment
# of its own below FOLDER (PYTHON names the interpreter; about 0.4 GB in all, a minute).
set -euo pipefail
address=$1
folder=$2
here="$(cd "$(dirname "$0")" && pwd)"
for package in mcp==2.3.0 openenv==0.10.0; do
    name=${package%%==*}
    if [ ! -f "$folder/$name/.installed" ]; then
        "${PYTHON:-python3}" -m venv --clear "$folder/$name"
        "$folder/$name/bin/python" -m pip install -q "$package"
        touch "$folder/$name/.installed"
    fi
    "$folder/$name/bin/python" "$here/client_of_$name.py" "$address"
done
