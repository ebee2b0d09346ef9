"""A bench is run seed by seed, and the finished part of an unfinished one can be read."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import pytest
from small_runs import Inline, small

from imagine_bench import registry
from imagine_bench.errors import ArtefactError
from imagine_bench.protocols.data import Encoders, ProtocolData
from imagine_bench.report.bench import bench_page
from imagine_bench.report.page import texts
from imagine_bench.running import bench as benches
from imagine_bench.store.files import read_sealed, sealed, write_json
from imagine_bench.store.loading import load_so_far
from imagine_bench.store.results import BenchResult

RUNS = [(agent, seed) for seed in (0, 1) for agent in ("imaginer", "table")]
"""In their order of work: of each seed, agents that are listed last come first."""


def bench(root: Path, launcher: Inline, **changes: object) -> BenchResult:
    wanted = small(**{"budgets": (2, 4, 9), "agents": ("table", "imaginer"), "seeds": (0, 1), **changes})
    return benches.bench(wanted, {}, root=root, launcher=launcher)


def test_a_bench_without_a_run_is_read_and_goes_on_elsewhere(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Agents without a result are left out once all others are finished."""
    with pytest.raises(KeyboardInterrupt):
        bench(tmp_path, Inline(patience=1), seeds=(0,))
    (folder,) = tmp_path.glob("arrow_puzzle/*")
    (done,) = (mark.parents[1].name for mark in folder.glob("*/seed_0/DONE"))
    (other,) = {"table", "imaginer"} - {done}
    part = load_so_far(folder)
    assert (part.protocol.agents, part.protocol.budgets) == ((done,), (2, 4, 9))
    assert part.missing == (f"{other} seed 0: 0 of 9 real episodes",)
    facts = read_sealed(folder / "sessions.json", "sessions")
    facts["environment"]["machine"]["cpu"] = "another"
    write_json(folder / "sessions.json", sealed(facts))
    for reads in (False, True):  # it goes on, and is then only read
        bench(tmp_path, Inline(), seeds=(0,))
        said = capsys.readouterr().out
        assert f"Note: {folder} was begun with another cpu. Runs it finished are kept" in said
        assert ("nothing was run" in said) == reads


def test_a_bench_lacks_its_unfinished_runs_alone(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        bench(tmp_path, Inline(patience=1))
    (folder,) = tmp_path.glob("arrow_puzzle/*")
    with pytest.raises(ArtefactError, match="No seed of this bench has brought every agent to 2 real episodes yet"):
        load_so_far(folder)
    with pytest.raises(KeyboardInterrupt):
        bench(tmp_path, Inline(patience=1))
    part = load_so_far(folder)
    assert (part.protocol.seeds, part.protocol.budgets) == ((0,), (2, 4, 9))
    assert part.missing == ("table seed 1: 0 of 9 real episodes", "imaginer seed 1: 0 of 9 real episodes")
    assert folder.name == f"smoke-{part.protocol_hash}"
    with pytest.raises(ArtefactError, match=r"seed 1: 0 of 9 real episodes\. Run the same bench command again to"):
        benches.load_bench(folder)
    elsewhere = shutil.copytree(folder, tmp_path / "carried elsewhere")
    assert load_so_far(elsewhere).protocol == part.protocol
    assert "1 of 2 seeds up to 9 of 9 real episodes" in bench_page(part).summary
    assert "This bench is not finished" in texts(bench_page(part))["index.html"]

    launcher = Inline()
    result = bench(tmp_path, launcher)
    assert launcher.order == RUNS[2:]
    assert result.missing == () and result.whole is None
    bench(tmp_path, launcher)
    assert launcher.order == RUNS[2:], "a finished bench is only read"
    (folder / "table/seed_0/DONE").unlink()
    part = load_so_far(folder)
    assert part.protocol == result.protocol == part.whole
    assert part.missing == ("table seed 0: its recording",)


def test_missing_runs_of_several_benches_are_counted_each_once(tmp_path: Path) -> None:
    one, other = (small(agents=(agent,), seeds=(0, 1), evaluation_episodes=1) for agent in ("random", "oracle"))
    planned: list[tuple[ProtocolData, Encoders]] = [(one, {}), (other, {}), (one, {})]
    for missing in (4, 0):
        assert benches.carry_out(planned, root=tmp_path, launcher=Inline()) == ([], missing)


@pytest.mark.usefixtures("own_names")
def test_the_costliest_run_of_a_seed_begins_first(tmp_path: Path) -> None:
    registry.AGENTS["table"] = dataclasses.replace(registry.AGENTS["table"], relative_cost=2.0)
    launcher = Inline(patience=2)
    with pytest.raises(KeyboardInterrupt):
        bench(tmp_path, launcher)
    assert launcher.order == [("table", 0), ("imaginer", 0)]
