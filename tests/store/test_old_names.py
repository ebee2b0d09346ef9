"""Files that hold names which agents had earlier: they are read under today's labels, and their hashes stay."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path

import pytest
from small_runs import Inline, final_arrays

from imagine_bench import registry
from imagine_bench.errors import ArtefactError, InvalidValueError
from imagine_bench.protocols.control import Protocol, protocol
from imagine_bench.registry.entries import agent_label, edition_of, label_today, name_in_edition_1
from imagine_bench.running.bench import bench, plan, read_protocol
from imagine_bench.store.bench_folder import bench_folder
from imagine_bench.store.loading import archive_files, load_so_far

KEPT = Path(__file__).parent / "of_abcb05c" / "two_names"
"""A bench of ``factored``, killed within its second test, and of ``factored_own``, which was done."""
HASH = "51e2eefd864f"
LEARNED = "86be7a126e3fc599"
"""Digest of all that ``factored_own`` had learned."""


@pytest.mark.parametrize("name", [*registry.AGENTS, "factored:planning.depth=1", "factored:given,planning.depth=1"])
def test_an_old_name_and_todays_label_translate_into_each_other(name: str) -> None:
    assert label_today(name_in_edition_1(name)) == name
    assert agent_label(name_in_edition_1(name), {}) == name
    assert agent_label(name, {"agent_names": 2}) == name


@pytest.mark.parametrize("agents", [("dqn",), ("factored",), ("factored:given",), ("factored", "factored:given")])
def test_a_new_protocol_is_read_as_it_was_written(agents: tuple[str, ...]) -> None:
    new = protocol("arrow_puzzle", "smoke", agents=agents)
    written = new.as_dict()
    assert written["agents"] == list(agents)
    assert ("agent_names" in written) == ("factored" in agents), "said only where edition 1 meant another agent"
    assert Protocol.from_dict(json.loads(json.dumps(written))) == new


@pytest.mark.parametrize("agents", [["factored"], ["factored_own"], ["dqn", "factored:planning.depth=1"], ["dqn"]])
def test_a_kept_protocol_keeps_its_text_and_hash(agents: list[str]) -> None:
    kept = protocol("arrow_puzzle", "smoke").as_dict() | {"agents": agents}
    read = Protocol.from_dict(kept)
    assert read.agents == tuple(label_today(agent) for agent in agents)
    assert read.as_dict() == kept
    same_labels = protocol("arrow_puzzle", "smoke", agents=read.agents)
    assert (read.hash == same_labels.hash) == (edition_of(agents) == 2), "the two editions never meet in one folder"


def test_an_old_name_is_refused_with_the_new_one() -> None:
    with pytest.raises(InvalidValueError, match=r"Agent 'factored_own' is now called 'factored'; give that name\."):
        registry.agent_entry("factored_own")


def files_of(folder: Path) -> dict[str, bytes]:
    kept = (path for path in folder.rglob("*") if path.is_file() and not path.name.startswith(".lock"))
    return {str(path.relative_to(folder)): path.read_bytes() for path in kept}


def test_a_kept_bench_has_todays_labels_and_its_own_version(tmp_path: Path) -> None:
    """Its finished run keeps the learned arrays. The other one cannot be finished as it would have been: the agent has
    learned otherwise since 2026-11-29.
    """
    kept = read_protocol(KEPT)
    assert kept.agents == ("factored:given", "factored")
    assert kept.hash == HASH
    _, paths = plan(kept.task, kept.preset, agents=kept.agents)
    folder = bench_folder(tmp_path, kept)
    shutil.copytree(KEPT, folder)
    launcher = Inline()
    with pytest.raises(ArtefactError, match=r"settings\.outcomes\.choice_decay None where 0\.02 .* that began it"):
        bench(kept, paths, root=tmp_path, launcher=launcher)
    assert [agent for agent, *_ in launcher.order] == ["factored:given"], "the other one was done"
    runs = ("factored/seed_0", "factored_own/seed_0")
    assert [files_of(folder / run) for run in runs] == [files_of(KEPT / run) for run in runs]
    learned = hashlib.sha256()
    for name, array in sorted(final_arrays(folder / runs[1]).items()):
        learned.update(name.encode() + array.tobytes())
    assert learned.hexdigest()[:16] == LEARNED
    for name, text in archive_files(load_so_far(KEPT)).items():
        (tmp_path / name).write_text(text)
    assert {run.agent for run in load_so_far(tmp_path).runs} == {*kept.agents}
