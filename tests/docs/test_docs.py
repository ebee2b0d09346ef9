"""Documents: links lead somewhere, commands could be carried out, Python runs."""

from __future__ import annotations

import json
import re
import shlex
import tomllib
from pathlib import Path
from typing import Any

import gymnasium
import matplotlib
import pytest
import repository
import thesis_elements
from doc_tables import PAGES
from kept import ROOT, table
from matplotlib import pyplot
from small_runs import do

import imagine_bench
from imagine_bench import registry
from imagine_bench.cli import ELSEWHERE, Bench, parsed
from imagine_bench.registry import AGENTS, has_task, regressions, task_of_motion

WRITTEN = [*PAGES, ROOT / "CHANGELOG.md"]
COMMAND = re.compile(r"(?:^|`)imagine-bench ([a-z]+ [^`\n#]+)", re.MULTILINE)
PYTHON = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
BLOCKS = [(page, code) for page in PAGES for code in PYTHON.findall(page.read_text())]
SCRIPTS = [(page, code) for page, code in BLOCKS if "class MyAgent" in code]
SHORT = 'preset="smoke", execution="kinematic", budgets=[2], evaluation_episodes=3, seeds=[1]'


def name(value: object) -> str:
    return str(value.relative_to(ROOT)) if isinstance(value, Path) else ""


def anchors(page: Path) -> set[str]:
    """Those that a page's headings have in the usual viewers."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", WRITTEN, ids=name)
def test_links_lead_somewhere(page: Path) -> None:
    for target, anchor in re.findall(r"\]\((?!https?:)([^)#\s]*)(?:#([^)\s]+))?\)", page.read_text()):
        there = page.parent / target if target else page
        assert there.exists(), f"{page} links to {target}"
        assert not anchor or anchor in anchors(there), f"{page} links to {target}#{anchor}"


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_paths_in_the_checkout_exist(page: Path) -> None:
    named = re.findall(r"`((?:agents|tasks|imagine_bench|assets|tests|docs)/[\w./-]*)`", page.read_text())
    assert not [path for path in named if path != "imagine_bench/" and not (ROOT / path).exists()]


def commands_of(page: Path) -> list[str]:
    said = COMMAND.findall(page.read_text())
    return [each for each in said if page.name != "CHANGELOG.md" or each.split()[0] not in ELSEWHERE]


def test_pages_name_commands() -> None:
    said = [each for page in WRITTEN for each in commands_of(page)]
    assert sum(each.startswith("bench ") for each in said) > 20


@pytest.mark.parametrize("page", [page for page in WRITTEN if commands_of(page)], ids=name)
def test_commands_could_be_carried_out(page: Path) -> None:
    """Options, tasks, agents and settings that a page names exist, and every bench could be begun.

    A page may also name a task that a command of the page makes.
    """
    made = re.findall(r"imagine-bench new task (\w+)", page.read_text())
    for said in commands_of(page):
        try:
            command = parsed(shlex.split(said))
        except SystemExit:
            pytest.fail(f"{page.name} names a command that is not understood: imagine-bench {said}")
        task = getattr(command, "task", None)
        is_known = task in (None, "TASK", "my_task", *made, *regressions(), *AGENTS) or has_task(task)
        assert is_known or task_of_motion(task), f"{page.name}: {said}"
        if isinstance(command, Bench) and not (
            command.learner.dataset or str(command.learner.encoder).endswith(".safetensors")
        ):
            command.planned()


@pytest.mark.usefixtures("own_folder", "own_names", "without_shadows")
@pytest.mark.parametrize(("page", "code"), [block for block in BLOCKS if block not in SCRIPTS], ids=name)
def test_python_on_pages_runs(page: Path, code: str) -> None:
    if "import lerobot" in code or "from lerobot" in code:
        pytest.importorskip("lerobot", reason="LeRobot is large, and no dependency of the tests")
    variables: dict[str, object] = {}
    exec(compile(code, str(page), "exec"), variables)
    if "env" in variables:
        variables["env"].close()  # type: ignore[attr-defined]
        assert isinstance(variables["env"], gymnasium.Env | gymnasium.vector.VectorEnv)


def script() -> str:
    """That of the front page, of which another page has a copy."""
    (page, code), (_, again) = SCRIPTS
    assert page.name == "README.md" and again == code
    lines = [line for line in code.splitlines() if line and not line.startswith("#")]
    assert len(lines) <= 10
    return code


@pytest.mark.usefixtures("own_names")
def test_the_ten_lines_define_an_agent(tmp_path: Path) -> None:
    variables: dict[str, Any] = {}
    exec(script().partition("result =")[0], variables)
    imagine_bench.register_agent("mine", variables["MyAgent"])
    assert do(tmp_path / "seed_0", "mine", agents=("mine",)).checkpoints


def cells() -> list[dict[str, Any]]:
    """The cells of the notebook that hold code."""
    found = json.loads((ROOT / "docs/tutorial/notebook.ipynb").read_text())["cells"]
    return [cell for cell in found if cell["cell_type"] == "code"]


@pytest.mark.usefixtures("own_names", "without_shadows")
def test_the_notebook_runs(own_folder: Path) -> None:
    matplotlib.use("agg")
    short = 'agents=["random", MyAgent], launcher="this_process", ' + SHORT
    code = "\n".join("".join(cell["source"]) for cell in cells()[1:])
    code = code.replace('agents=["random", "dqn", MyAgent], preset="smoke"', short)
    assert SHORT in code
    exec(code, {})
    pyplot.close("all")
    assert len(list(own_folder.glob("runs/arrow_puzzle/*/MyAgent/seed_1/DONE"))) == 1


def test_the_notebook_keeps_the_outputs_of_a_run_without_errors(capsys: pytest.CaptureFixture[str]) -> None:
    """The printed steps are those that the environment gives; the site shows these outputs."""
    _, first, *_ = cells()
    outputs = [output for cell in cells() for output in cell["outputs"]]
    assert "error" not in {each["output_type"] for each in outputs}
    assert sum("image/png" in each.get("data", {}) for each in outputs) == 2
    exec("".join(first["source"]), {})
    assert capsys.readouterr().out == "".join(first["outputs"][0]["text"]) and "reward 50.0" in str(first["outputs"])


def test_the_first_cell_of_the_notebook_installs_this_checkout() -> None:
    """As IPython carries it out, where the package is not installed yet; the notebook's folder is the current one."""
    ((path, extras),) = re.findall(r'^ *%pip install -q "(\S+)\[(.*)\]"', "".join(cells()[0]["source"]), re.MULTILINE)
    project = tomllib.loads((ROOT / "docs/tutorial" / path / "pyproject.toml").read_text())["project"]
    assert project["name"] == "imagine-bench"
    assert set(extras.split(",")) <= set(project["optional-dependencies"])


def test_the_elements_of_the_thesis_are_where_they_are_said_to_be() -> None:
    rows = thesis_elements.elements()
    assert not [lacks for row in rows if (lacks := thesis_elements.missing(row))]
    assert {row["verdict"] for row in rows} <= set(thesis_elements.VERDICTS)
    compared = [row for row in rows if row["verdict"] in ("agrees", "contradicts", "cannot be told")]
    assert not [row["element"] for row in compared if not (row["tests"] and (row["page"] or row["here"]))]
    assert not [row["element"] for row in rows if row["verdict"] == "missing"], "all is built"
    assert thesis_elements.PAGE.read_text() == thesis_elements.page(), "python tests/docs/thesis_elements.py"


def test_planted_bugs_are_noticed_or_have_a_reason() -> None:
    rows = table("mutants/mutants.csv")
    reasons = [row["why"] for row in rows if row["result"] == "passed"]
    assert all(reasons) and len(reasons) <= 0.08 * len(rows)
    said = f"plants {len(rows)} small bugs.*: {len(rows) - len(reasons)}, and each of the other {len(reasons)} has"
    assert re.search(said, (ROOT / "CONTRIBUTING.md").read_text())


def test_kept_numbers_are_what_every_json_reader_can_read() -> None:
    files = sorted((ROOT / "docs" / "results").rglob("*.json"))
    assert len(files) > 40
    for file in files:
        json.loads(file.read_text(), parse_constant=lambda word, file=file: pytest.fail(f"{file} holds {word}"))


@pytest.mark.parametrize("page", sorted((ROOT / "docs" / "environments").glob("*.md")), ids=name)
def test_pages_of_environments_say_what_their_rules_say(page: Path) -> None:
    text, spec = page.read_text(), registry.task(page.stem)
    facts = spec.facts()
    true = {
        r"macro-actions solve (?:1 of 46 episodes \()?([\d.]+) %": 100 * facts.chance_level,
        r"with ([\d.]+) macro-actions on average": facts.mean_plan_length,
        r"Each of the (\d+) macrostates": len(spec.rules.start_states),
        r"`Discrete\((\d+)\)`": spec.rules.n_actions,
        r"Truncated\* after (\d+) macro-actions": spec.horizon,
    }
    said = [(value, fact) for pattern, fact in true.items() for value in re.findall(pattern, text)]
    assert len(said) >= (0 if page.stem == "arrows" else 3)
    assert not [(value, fact) for value, fact in said if round(fact, len(value.partition(".")[2])) != float(value)]


def test_the_front_page_has_the_links_of_its_address() -> None:
    """Badges and full links once there is an address; without one, none, and no address is made up."""
    page = (ROOT / "README.md").read_text()
    assert page == repository.with_badges(page, repository.REPOSITORY)
    marked = "<!-- badges -->\n<!-- end of badges -->\n![arm](docs/img/turn.gif) [docs](docs/index.md) [own](#cite)\n"
    assert repository.with_badges(marked, "") == repository.with_absolute_links(marked, "") == marked
    address = "https://github.com/owner/name"
    assert repository.with_badges(marked, address).count(address) == 2
    full = repository.with_absolute_links(marked, address)
    assert "![arm](https://raw.githubusercontent.com/owner/name/main/docs/img/turn.gif)" in full
    assert f"[docs]({address}/blob/main/docs/index.md) [own](#cite)" in full
