"""Build the page of the puzzle: ``make browser`` writes build/browser/play, which any static server can serve.

MuJoCo's own WebAssembly build comes from npm in a pinned version, whose bytes are checked. Everything else is made from
the package: scenes, planned motions, a world model, frames, and rows of the board.
"""

from __future__ import annotations

import base64
import hashlib
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

import constants
import rows
import scenes
import world_model

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
OUT = ROOT / "build" / "browser" / "play"
PACKAGE = "@mujoco/mujoco@3.14.0"
INTEGRITY = "WPUYidu4Fx8+uM4hQv80SOA0ifpWGrsNJguKs8JBV8SCTxjKQ2/rqsh880nUH0/Vwa8vuefghvCQkkoed3bkUg=="
"""Base64 of the SHA-512 of the package's archive."""
TAKEN = ("mujoco.js", "mujoco.wasm")
LARGEST = 16_000_000
"""Bytes of the whole page on disk."""


def fetch(folder: Path) -> None:
    """Put MuJoCo's two files into a folder.

    Raises:
        SystemExit: npm is missing or cannot reach its registry, or the archive is not the pinned one.
    """
    npm = shutil.which("npm")
    if npm is None:
        raise SystemExit(
            "The page needs MuJoCo's WebAssembly build from npm, and npm is not installed; install Node.js."
        )
    with tempfile.TemporaryDirectory() as scratch:
        done = subprocess.run([npm, "pack", "--silent", PACKAGE], cwd=scratch, check=False, stdout=subprocess.DEVNULL)
        archives = list(Path(scratch).glob("*.tgz"))
        if done.returncode or len(archives) != 1:
            raise SystemExit(f"npm could not fetch {PACKAGE}; see its message above, and run make browser again.")
        found = base64.b64encode(hashlib.sha512(archives[0].read_bytes()).digest()).decode()
        if found != INTEGRITY:
            raise SystemExit(f"The archive of {PACKAGE} has another SHA-512 than the pinned one; nothing was taken.")
        folder.mkdir(parents=True, exist_ok=True)
        with tarfile.open(archives[0]) as archive:
            for name in TAKEN:
                member = archive.extractfile(f"package/{name}")
                assert member is not None
                (folder / name).write_bytes(member.read())


def main() -> None:
    """Build the whole page anew, but keep MuJoCo's files and the trained model where they are there."""
    data = OUT / "data"
    data.mkdir(parents=True, exist_ok=True)
    for path in (HERE / "page").iterdir():
        shutil.copy(path, OUT)
    (OUT / "constants.js").write_text(constants.text())
    if not all((OUT / "mujoco" / name).is_file() for name in TAKEN):
        fetch(OUT / "mujoco")
    scenes.write(data)
    rows.write(data / "rows")
    if not (data / "model.bin").is_file():
        world_model.write(data)
    size = sum(path.stat().st_size for path in OUT.rglob("*") if path.is_file())
    if size > LARGEST:
        raise SystemExit(f"The page has {size:,} bytes; give at most {LARGEST:,}.")
    served = OUT.parent.relative_to(ROOT)
    sys.stdout.write(f"{served}/{OUT.name}: {size / 1e6:.1f} MB. Serve it: python -m http.server -d {served}\n")


if __name__ == "__main__":
    main()
