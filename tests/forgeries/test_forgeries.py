"""Forged benches are found: by playing again, or by training one run of each agent again."""

from __future__ import annotations

import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from forging import Forger, shared_bench
from kinds import KINDS, Donors

from imagine_bench.errors import ArtefactError, CheckFailedError, ImagineBenchError
from imagine_bench.running.retraining import Retraining
from imagine_bench.tools import audits

WAYS = ("replay", "training", "in part", "passed")
PASSING = ("a failed seed dropped", "prices invented")
"""Forgeries that pass even where every run of an agent is forged, as docs/how_to/verify.md says."""


class Court:
    """An honest bench, and the verdict on forged copies of it."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.honest, self.launcher = shared_bench()
        self.donors = Donors(root / "donors")
        self.reasons: list[str] = []

    def forged(self, kind: str, variant: int, *, every: bool, cpu: str = "") -> tuple[Path, Forger]:
        """A forgery that a report reads."""
        for attempt in range(50):
            rng = np.random.default_rng([list(KINDS).index(kind), variant, every, attempt])
            forger = Forger(self.honest, self.root / f"{kind} {variant} {every} {cpu} {attempt}", rng, every=every)
            try:
                KINDS[kind](forger, self.donors)
                return forger.finish(cpu), forger
            except (ArtefactError, KeyError, TypeError) as error:  # the project's own reader misses a part
                self.reasons.append(f"unreadable: {kind}: {forger.drawn}: {error}")
        raise AssertionError(kind)

    def verdict(self, folder: Path, nonce: str) -> str:
        """How a folder is found out: by "replay", by "training", "in part" (exit code 3); or it has "passed"."""
        error: ImagineBenchError | None = None
        for again in (None, Retraining(runs=1, nonce=nonce, launcher=self.launcher, encoder=None, dataset=None)):
            found = "replay" if again is None else "training"
            try:
                verdicts = audits.verify(folder, again)
                error = audits.conclusion(verdicts)
            except ImagineBenchError as unreadable:
                error = CheckFailedError(str(unreadable))
            if isinstance(error, CheckFailedError):
                self.reasons.append(f"{found}: {folder}: {next((v for v in verdicts if v.complaint), error)}")
                return found
        self.reasons.append(f"not found: {folder}: {error}")
        return "in part" if error else "passed"


@pytest.fixture(scope="module")
def court(tmp_path_factory: pytest.TempPathFactory) -> Court:
    return Court(tmp_path_factory.mktemp("court"))


def test_honest_results_hold(court: Court) -> None:
    assert court.verdict(court.honest, "0") == "passed"


SLOWEST = "the best seed copied"  # every run is a copy, and each is played again


@pytest.mark.parametrize(
    "kind",
    [pytest.param(kind, marks=[pytest.mark.slow] * (kind == SLOWEST)) for kind in KINDS if kind not in PASSING],
)
def test_a_forged_agent_is_found(court: Court, kind: str) -> None:
    """With every run of an agent forged, playing again or training one run again shows it."""
    folder, forger = court.forged(kind, 3 if "later" in kind else 0, every=True)  # none from a longer run
    assert court.verdict(folder, "nonce") != "passed", forger.drawn


@pytest.mark.parametrize("kind", ["the oracle's tests", "agents swapped", "a seed renamed, its starts remade"])
def test_a_forged_agent_is_found_though_another_processor_is_claimed(court: Court, kind: str) -> None:
    folder, forger = court.forged(kind, 0, every=True, cpu="Another CPU")
    assert court.verdict(folder, "nonce") == "training", forger.drawn


@pytest.mark.slow
@pytest.mark.parametrize(("every", "cpu", "variants"), [(True, "", 30), (True, "Another CPU", 10), (False, "", 30)])
def test_at_most_three_kinds_pass(
    court: Court, capsys: pytest.CaptureFixture[str], every: bool, cpu: str, variants: int
) -> None:
    """Printed: how many forgeries playing again finds, training again finds, are held in part, and pass."""
    lines = []
    passing = set()
    for kind in KINDS:
        found = Counter[str]()
        for variant in range(variants):
            folder, _ = court.forged(kind, variant, every=every, cpu=cpu)
            found[court.verdict(folder, f"{kind} {variant}")] += 1
            shutil.rmtree(folder.parents[1])
        lines.append(f"{kind:36}  {'/'.join(f'{found[way]:2}' for way in WAYS)}")
        if found["passed"] > 1:  # one forgery may be the same to the bit in the run that is drawn
            passing.add(kind)
    with capsys.disabled():
        print(f"\n{'every run of an agent' if every else 'one run'}, {cpu}: {' / '.join(WAYS)}", *lines, sep="\n")
    assert not every or passing <= set(PASSING)
