"""What packages of others do wrong is one sentence, and costs nobody else's results."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import gymnasium
import pytest
from guest_packages import install
from small_runs import Inline

from imagine_bench import registry
from imagine_bench.cli import main
from imagine_bench.errors import InvalidValueError, RunFailedError
from imagine_bench.running.bench import bench, plan
from imagine_bench.store.loading import load_so_far
from imagine_bench.tools.new import new_package

_FEW = {"budgets": (2,), "evaluation_episodes": 2, "open_loop_starts": 0, "recorded_episodes": 0}


@pytest.fixture(autouse=True)
def forgotten() -> Iterator[None]:
    yield
    registry.offers.cache_clear()
    gymnasium.registry.pop("lamps/Lamps-v0", None)


def package(kind: str, name: str, at: Path, monkeypatch: pytest.MonkeyPatch, *changes: tuple[str, str]) -> None:
    """A new package with some of its code replaced, installed."""
    new_package(kind, name, at)
    module = at / name / f"{name}.py"
    code = module.read_text()
    for old, new in changes:
        assert old in code
        code = code.replace(old, new)
    module.write_text(code)
    monkeypatch.syspath_prepend(install(at / name))
    monkeypatch.delitem(sys.modules, name, raising=False)
    registry.offers.cache_clear()


_TASK, _AGENT = ("task", "lamps"), ("agent", "clumsy")


@pytest.mark.parametrize(
    ("guest", "old", "new", "sentence"),
    [
        (_TASK, 'spec="lamps:SPEC"', 'spec="lamps:RULES"', "Task lamps (lamps:RULES) cannot be used (AttributeError: "),
        (_TASK, 'spec="lamps:SPEC"', 'spec="lamps:HORIZON"', "(TypeError: it is 8 and no TaskSpec); mend or uninstall"),
        (_TASK, 'id="lamps",', 'id="lamp",',
         "says id 'lamp' where the registry line or the rules of lamps say 'lamps'"),
        (_TASK, "Outcome(1.0,", "Outcome(0.9,", "Outcomes of action 0 in macrostate (0, 0, 0, 0) sum to 0.9, not 1."),
        (_TASK, "from_xml_string(_SCENE)", "from_xml_string('<no')", "Task lamps cannot be run: "),
        (_TASK, "np.stack([_board()", "1.0 * np.stack([_board()", "gives frames of float64 and shape (64, 64, 3)"),
        (_TASK, "return self._board.frame(self._state), self._info(success=False)",
         "return self._board.frame(self._state)[::2], self._info(success=False)",
         "its environment gives frames of uint8 and shape (32, 64, 3)"),
        (_AGENT, "self.n_actions = context.n_actions", "self.n_actions = context.actions",
         "Agent clumsy (clumsy:Clumsy) cann"),
        (_AGENT, 'title="Clumsy"', 'settings="clumsy:NONE"',
         "Agent clumsy, its settings (clumsy:NONE) cannot be used (Attribu"),
    ],
)  # fmt: skip
def test_a_guests_fault_is_said_before_anything_runs(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    guest: tuple[str, str],
    old: str,
    new: str,
    sentence: str,
) -> None:
    package(*guest, tmp_path, monkeypatch, (old, new))
    words = (
        ["--task", "lamps", "--agents", "random"]
        if guest == _TASK
        else ["--task", "arrow_puzzle", "--agents", "clumsy"]
    )
    assert main(["bench", *words, "--out", str(tmp_path / "runs")]) == 2
    said = capsys.readouterr().err
    assert sentence in said and said.count("\n") == 1, said


def test_frames_and_rewards_that_go_wrong_later_end_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    step = "return self._board.frame(self._state), outcome.reward,"
    for index, (new, sentence) in enumerate(
        (
            (
                "return self._board.frame(self._state) * np.nan, outcome.reward,",
                "an observation that is not in its space",
            ),
            (
                "return self._board.frame(self._state)[:9], outcome.reward,",
                "an observation that is not in its space",
            ),
            ("return self._board.frame(self._state), float('nan'),", "gave the reward nan; rewards are finite"),
        )
    ):
        package("task", "lamps", tmp_path / str(index), monkeypatch, (step, new))
        gymnasium.registry.pop("lamps/Lamps-v0", None)
        wanted, paths = plan("lamps", "smoke", agents=("random",), execution="kinematic", **_FEW)
        with pytest.raises(InvalidValueError) as caught:
            bench(wanted, paths, root=tmp_path / f"runs{index}", launcher=Inline())
        assert sentence in str(caught.value)


def test_an_agent_that_fails_costs_the_others_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    package(
        "agent",
        "clumsy",
        tmp_path,
        monkeypatch,
        ("target = transition", 'raise RuntimeError("oh"); target = transition'),
    )
    wanted, paths = plan("arrow_puzzle", "smoke", agents=("random", "clumsy"), execution="kinematic", **_FEW)
    with pytest.raises(RunFailedError, match=r"1 of 2 runs failed(.|\n)*clumsy seed 0 in arrow_puzzle: oh"):
        bench(wanted, paths, root=tmp_path, launcher=Inline())
    (folder,) = (tmp_path / "arrow_puzzle").iterdir()
    part = load_so_far(folder)
    assert part.protocol.agents == ("random",) and part.missing == ("clumsy seed 0: 0 of 2 real episodes",)
    assert main(["report", str(folder)]) == 0
    assert "Missing are clumsy seed 0: 0 of 2 real episodes." in capsys.readouterr().out


def test_settings_of_the_physics_are_refused_where_there_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    package("task", "lamps", tmp_path, monkeypatch)
    assert main(["bench", "--task", "lamps", "--agents", "random", "--physics", "pad_friction=0.5"]) == 2
    assert "Physics settings change nothing in kinematic execution; leave" in capsys.readouterr().err
    assert main(["bench", "--task", "lamps", "--agents", "random", "--execution", "physics"]) == 2
    assert "No execution 'physics'. Known: kinematic." in capsys.readouterr().err
    assert main(["bench", "--task", "lamps", "--agents", "random", "--observation", "state"]) == 2
    assert "Task lamps cannot be run: " in (said := capsys.readouterr().err) and "argument 'observation'" in said
