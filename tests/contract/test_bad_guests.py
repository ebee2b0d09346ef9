"""A fault of another package is one sentence, and costs nobody else's results."""

from __future__ import annotations

from pathlib import Path

import pytest
from guest_packages import Guests
from small_runs import benched

from imagine_bench.cli import exit_code as main
from imagine_bench.errors import InvalidValueError

_TASK, _AGENT = ("task", "lamps"), ("agent", "clumsy")
_FRAME = "return self._board.frame(self._state)"


@pytest.mark.parametrize(
    ("guest", "old", "new", "sentence"),
    [
        (_TASK, 'spec="lamps:SPEC"', 'spec="lamps:RULES"', "Task lamps (lamps:RULES) cannot be used (AttributeError: "),
        (_TASK, 'spec="lamps:SPEC"', 'spec="lamps:HORIZON"', "(TypeError: it is 8 and no TaskSpec); mend or uninstall"),
        (_TASK, "Outcome(1.0,", "Outcome(0.9,", "Outcomes of action 0 in macrostate (0, 0, 0, 0) sum to 0.9, not 1."),
        (_TASK, "from_xml_string(_SCENE)", "from_xml_string('<no')", "Task lamps cannot be run: "),
        (_TASK, "np.stack([_board()", "1.0 * np.stack([_board()", "gives frames of float64 and shape (64, 64, 3)"),
        (_TASK, f"{_FRAME}, self._info(success=False)", f"{_FRAME}[::2], self._info(success=False)",
         "its environment gives frames of uint8 and shape (32, 64, 3)"),
        (_AGENT, "self.n_actions = context.n_actions", "self.n_actions = context.actions",
         "Agent clumsy (clumsy:Clumsy) cann"),
        (_AGENT, 'title="Clumsy"', 'settings="clumsy:NONE"',
         "Agent clumsy, its settings (clumsy:NONE) cannot be used (Attribu"),
    ],
)  # fmt: skip
def test_a_guests_fault_is_said_before_anything_runs(
    guests: Guests,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    guest: tuple[str, str],
    old: str,
    new: str,
    sentence: str,
) -> None:
    guests.new(*guest, (old, new))
    words = "lamps --agents random" if guest == _TASK else "arrow_puzzle --agents clumsy"
    assert main(["bench", "--task", *words.split(), "--out", str(tmp_path / "runs")]) == 2
    said = capsys.readouterr().err
    assert sentence in said and said.count("\n") == 1, said


@pytest.mark.parametrize(
    ("new", "sentence"),
    [
        (f"{_FRAME} * np.nan, outcome.reward,", "an observation that is not in its space"),
        (f"{_FRAME}, float('nan'),", "gave the reward nan; rewards are finite"),
    ],
)
def test_frames_and_rewards_that_go_wrong_later_end_the_run(
    guests: Guests, tmp_path: Path, new: str, sentence: str
) -> None:
    guests.new(*_TASK, (f"{_FRAME}, outcome.reward,", new))
    with pytest.raises(InvalidValueError, match=sentence):
        benched(tmp_path, "lamps", "random", budgets=(2,), evaluation_episodes=2)


@pytest.mark.parametrize(
    ("option", "sentence"),
    [
        ("--physics pad_friction=0.5", "Physics settings change nothing in kinematic execution; leave"),
        ("--execution physics", "No execution 'physics'. Known: kinematic."),
        ("--observation state", "argument 'observation'"),
    ],
)
def test_options_that_a_task_lacks_are_refused(
    guests: Guests, capsys: pytest.CaptureFixture[str], option: str, sentence: str
) -> None:
    guests.new(*_TASK)
    assert main(["bench", "--task", "lamps", "--agents", "random", *option.split()]) == 2
    assert sentence in capsys.readouterr().err


@pytest.mark.parametrize(
    "end", ["import sys\nsys.exit()", "raise SystemExit(0)", "raise type('Stop', (BaseException,), {})"]
)
def test_a_package_that_ends_python_costs_itself_alone(
    guests: Guests, capsys: pytest.CaptureFixture[str], end: str
) -> None:
    guests.write("ending", end, {"imagine_bench.agents": {"ending": "ending:ENTRY"}})
    assert main(["describe"]) == 0
    said = capsys.readouterr().out
    assert "oracle" in said and "arrow_puzzle" in said and "it ends Python when it is imported" in said
    assert main(["bench", "arrow_puzzle", "--agents", "ending"]) == 2


@pytest.mark.parametrize(
    ("words", "then"),
    [
        ("bench arrow_puzzle --agents stopping", "goes on from the last checkpoints"),
        ("judge arrow_puzzle --models stopping", "goes on from the last checkpoints"),
        ("sweep --agents stopping", "goes on from the last checkpoints"),
        ("list", "begins anew"),
    ],
)
def test_an_interrupted_command_says_how_it_goes_on(
    guests: Guests, capsys: pytest.CaptureFixture[str], words: str, then: str
) -> None:
    offers = {f"imagine_bench.{group}": {"stopping": "stopping:ENTRY"} for group in ("agents", "world_models")}
    guests.write("stopping", "raise KeyboardInterrupt", offers)
    assert main(words.split()) == 130
    assert capsys.readouterr().err == f"imagine-bench: interrupted; the same command {then}.\n"


_RED = "\x1b[31m"


@pytest.mark.parametrize("kind", [_TASK, _AGENT])
def test_texts_with_control_characters_are_refused(
    guests: Guests, capsys: pytest.CaptureFixture[str], kind: tuple[str, str]
) -> None:
    """They would reach terminals, pages and recordings."""
    name = kind[1].capitalize()
    guests.new(*kind, (f'title="{name}"', 'title="\\x1b[31m"'))
    words = "lamps --agents random" if kind == _TASK else "arrow_puzzle --agents clumsy"
    assert main(["bench", *words.split()]) == 2
    said = capsys.readouterr().err
    assert "control characters" in said and _RED not in said


def test_no_control_character_reaches_the_terminal(guests: Guests, capsys: pytest.CaptureFixture[str]) -> None:
    guests.write("shy", "", {"imagine_bench.agents": {f"shy{_RED}": "shy:ENTRY"}})
    assert main(["describe"]) == 0
    said = capsys.readouterr().out
    assert _RED not in said and r"shy\x1b[31m" in said


_ODD = """from imagine_bench.registry.entries import AgentEntry, RegressorEntry, WorldModelEntry

class _Settings:
    groups = {"chapter_5": None}

    def resolve(self, *given):
        return 1 // 0

    inert = names = resolve

def spell(argument):
    return argument

SETTINGS = _Settings()
AGENT = AgentEntry(make="odd:make", settings="odd:SETTINGS")
PREFIX = AgentEntry(make="odd:make", settings="odd:SETTINGS", argument="odd:spell")
REGRESSOR = RegressorEntry(make="odd:make", settings="odd:SETTINGS", title="Odd", description="Odd.")
MODEL = WorldModelEntry(make="odd:make", settings="odd:SETTINGS", title="Odd")
"""


@pytest.mark.parametrize(
    ("offer", "words", "what"),
    [
        ("agents AGENT", "describe odd", "odd"),
        ("agents PREFIX", "describe odd", "odd:ARGUMENT"),
        ("agents AGENT", "bench arrow_puzzle --agents odd", "Agent odd"),
        ("regressors REGRESSOR", "describe odd", "odd"),
        ("regressors REGRESSOR", "bench robot_ik --agents odd", "Regressor odd"),
        ("world_models MODEL", "describe odd", "odd"),
        ("world_models MODEL", "judge arrow_puzzle --models odd:rate=1", "World model odd:rate=1"),
    ],
)
def test_settings_that_fail_are_a_sentence_in_every_command(
    guests: Guests, capsys: pytest.CaptureFixture[str], offer: str, words: str, what: str
) -> None:
    group, name = offer.split()
    guests.write("odd", _ODD, {f"imagine_bench.{group}": {"odd": f"odd:{name}"}})
    assert main(words.split()) == 2
    said = capsys.readouterr().err
    assert f"{what}, its settings (odd:SETTINGS) cannot be used (ZeroDivisionError: " in said and said.count("\n") == 1
