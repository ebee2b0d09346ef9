"""Forged benches are found: by playing again, or by training one run of each agent again."""

from __future__ import annotations

import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from forging import Forger, Remembering, honest_bench
from kinds import KINDS, Donors

from imagine_bench.errors import ArtefactError, ImagineBenchError
from imagine_bench.running.retraining import Retraining
from imagine_bench.tools import audits

VARIANTS = 30
PASSING = ("a failed seed dropped", "prices invented")
"""Forgeries that pass even where every run of an agent is forged, as docs/how_to/verify.md says."""


class Court:
    """An honest bench, and the verdict on forged copies of it."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.launcher = Remembering(root / "trained")
        self.honest = honest_bench(root / "honest", self.launcher)
        self.donors = Donors(root / "donors")
        self.reasons: list[str] = []

    def forged(self, kind: str, variant: int, *, every: bool, cpu: str = "") -> tuple[Path, Forger]:
        """A forgery that a report reads."""
        for attempt in range(50):
            rng = np.random.default_rng([list(KINDS).index(kind), variant, every, attempt])
            forger = Forger(self.honest, self.root / f"{kind} {variant} {every} {attempt}", rng, every=every)
            try:
                KINDS[kind](forger, self.donors)
                return forger.finish(cpu), forger
            except (ArtefactError, KeyError, TypeError) as error:  # the project's own reader misses a part
                self.reasons.append(f"unreadable: {kind}: {forger.drawn}: {error}")
        raise AssertionError(kind)

    def verdict(self, folder: Path, nonce: str) -> str:
        """How a folder is found out: "replay", "training", or "passed"."""
        for again in (None, Retraining(runs=1, nonce=nonce, launcher=self.launcher, encoder=None, dataset=None)):
            found = "replay" if again is None else "training"
            try:
                complaints = [verdict for verdict in audits.verify(folder, again) if verdict.complaint]
            except ImagineBenchError as error:
                complaints = [error]
            if complaints:
                self.reasons.append(f"{found}: {folder}: {complaints[0]}")
                return found
        return "passed"


@pytest.fixture(scope="module")
def court(tmp_path_factory: pytest.TempPathFactory) -> Court:
    return Court(tmp_path_factory.mktemp("court"))


def test_honest_results_hold(court: Court) -> None:
    assert court.verdict(court.honest, "0") == "passed"


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in PASSING])
def test_a_forged_agent_is_found(court: Court, kind: str) -> None:
    """With every run of an agent forged, playing again or training one run again shows it."""
    folder, forger = court.forged(kind, 3 if "later" in kind else 0, every=True)  # none from a longer run
    assert court.verdict(folder, "nonce") != "passed", forger.drawn


@pytest.mark.slow
def test_at_most_three_kinds_pass(court: Court, capsys: pytest.CaptureFixture[str]) -> None:
    """Thirty forgeries of each kind; printed: how many playing again finds, training again finds, and pass."""
    lines = [f"{'kind':36}  every run of an agent   one run"]
    passing = set()
    for kind in KINDS:
        cells = []
        for every in (True, False):
            found = Counter[str]()
            for variant in range(VARIANTS):
                folder, _ = court.forged(kind, variant, every=every)
                found[court.verdict(folder, f"{kind} {variant}")] += 1
                shutil.rmtree(folder.parents[1])
            cells.append("/".join(f"{found[way]:2}" for way in ("replay", "training", "passed")))
            if every and found["passed"]:
                passing.add(kind)
        lines.append(f"{kind:36}  {cells[0]:22}  {cells[1]}")
    with capsys.disabled():
        print("\nfound by replay / by training again / passed", *lines, sep="\n")
    assert passing <= set(PASSING)
    assert len(PASSING) <= 3
