"""The time until the built page of the puzzle can be played, and its size.

    make browser
    npm install --prefix build/playwright playwright-core@1.65
    python tests/measure/page_ready.py build/playwright

Each visit starts a Chromium of its own, with an empty cache, and loads the page from a server on this machine; requests
to anywhere else are refused. The clock runs from the request of the page until keys work and the first image is drawn.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import gzip
import http.server
import json
import shutil
import statistics
import subprocess
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
PLAY = ROOT / "build" / "browser" / "play"
VISIT = ROOT / "tests" / "browser" / "visit.mjs"
MOST_S = 3.0
"""The longest time that is asked."""


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: object) -> None:
        """Say nothing."""


@contextlib.contextmanager
def served(folder: Path) -> Iterator[str]:
    """The address of a folder on this machine, while it is served."""
    handler = functools.partial(_Quiet, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def sizes_bytes() -> tuple[int, int]:
    """Bytes of all files of the page, on the disk and gzipped one by one."""
    files = [path.read_bytes() for path in PLAY.rglob("*") if path.is_file()]
    return sum(map(len, files)), sum(len(gzip.compress(content, 6)) for content in files)


def ready_s(modules: Path, chromium: str, address: str, width_px: int) -> float:
    """Seconds until the page can be played, in a new browser."""
    with tempfile.TemporaryDirectory() as folder:
        picture = Path(folder) / "page.png"
        given = (modules.absolute(), chromium, address, width_px, picture, "world=arrow_puzzle&seed=400", "")
        done = subprocess.run(["node", str(VISIT), *map(str, given)], capture_output=True, text=True, check=True)
    seen = json.loads(done.stdout)
    if seen["ready"] != "yes" or seen["errors"] or seen["outside"]:
        raise SystemExit(f"The page did not load as it should: {seen}")
    return float(seen["ready_s"])


def main() -> int:
    """Print times and sizes; 1 if a median is above the limit."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("modules", type=Path, help="folder whose node_modules hold playwright-core")
    parser.add_argument("--times", type=int, default=7)
    options = parser.parse_args()
    chromium = shutil.which("chromium") or shutil.which("google-chrome") or "chromium"
    worst = 0.0
    with served(PLAY) as address:
        for width_px in (1200, 400):
            times_s = [ready_s(options.modules, chromium, address, width_px) for _ in range(options.times)]
            median_s = statistics.median(times_s)
            worst = max(worst, median_s)
            spread = f"median {median_s:.1f} s, slowest {max(times_s):.1f} s of {len(times_s)} visits"
            print(f"{width_px} px wide: playable after {spread}; {MOST_S:g} s asked")
    on_disk, gzipped = sizes_bytes()
    print(f"{on_disk / 1e6:.1f} MB on the disk, {gzipped / 1e6:.1f} MB gzipped")
    return int(worst > MOST_S)


if __name__ == "__main__":
    raise SystemExit(main())
