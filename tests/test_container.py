"""The Dockerfile's steps, in a root of their own: nothing of this checkout's environment, nothing of anybody's home."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

_TOP = Path(__file__).parent.parent
_SETTINGS = re.compile(r"(PIP_|UV_|SSL_|TORCH_INDEX|https?_proxy|no_proxy)", re.IGNORECASE)
"""Variables that say where packages are fetched."""
_NEW_ROOT = """
set -euo pipefail
mount -t tmpfs tmpfs "$1"
mkdir "$1/upper" "$1/work" "$1/root"
mount -t overlay overlay -o "lowerdir=/,upperdir=$1/upper,workdir=$1/work" "$1/root"
mount -t proc proc "$1/root/proc"
mount --rbind /dev "$1/root/dev"
mount -t tmpfs tmpfs "$1/root/tmp"
rm -rf "$1/root$3"
mkdir -p "$1/root$3" "$1/root/home/new"
git -C "$2" ls-files -coz --exclude-standard | tar -C "$2" -c --null --ignore-failed-read -T - | tar -C "$1/root$3" -x
ln -sf "$4" "$1/root/usr/local/bin/python3"
exec chroot "$1/root" /bin/bash -euo pipefail -c "$5"
"""


def _can_make_roots() -> bool:
    words = ["unshare", "-m", "mount", "-t", "tmpfs", "tmpfs", "/mnt"]
    return os.name == "posix" and os.getuid() == 0 and subprocess.run(words, check=False).returncode == 0


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux" or not _can_make_roots(), reason="only root makes new roots")
def test_its_steps_end_in_both_commands_of_a_newcomer(tmp_path: Path) -> None:
    text = (_TOP / ".ci/Dockerfile").read_text()
    found = [line.split(" ", 1) for line in text.splitlines() if line and not line.startswith("#")]
    assert [name for name, _ in found] == ["FROM", "RUN", "WORKDIR", "COPY", "RUN", "CMD"]
    (_, install), (_, folder), (_, copied), (_, setup), (_, command) = found[1:]
    assert copied == ". ." and json.loads(command) == ["make", "test"]
    few = [f"{shlex.join(json.loads(command))} PYTEST= ARGS=tests/test_seeding.py"]
    few += ["make bench TASK=arrow_puzzle PRESET=smoke AGENTS='random dqn' ARGS='--budgets 3 --evaluation-episodes 3'"]
    steps = [f"cd {folder}", f"({install}) >/dev/null", setup, *few, "ls runs/arrow_puzzle/*/report/index.html"]
    python = str(Path(sys.base_prefix, "bin", "python3").resolve())
    words = ["unshare", "-m", "bash", "-c", _NEW_ROOT, "new_root", str(tmp_path), str(_TOP), folder, python]
    clean = {name: value for name, value in os.environ.items() if _SETTINGS.match(name)}
    clean |= {"PATH": "/usr/local/bin:/usr/bin:/bin:/usr/sbin:/sbin", "HOME": "/home/new"}
    done = subprocess.run([*words, "\n".join(steps)], capture_output=True, text=True, env=clean, check=False)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    assert "setup: ready" in done.stdout and " passed" in done.stdout and "report/index.html" in done.stdout
