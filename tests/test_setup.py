"""``.ci/setup.sh`` run for real, with interpreters that only pretend, and the Makefile's use of its variables."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from subprocess import PIPE, STDOUT

import pytest

ROOT = Path(__file__).parents[1]
TOOLS = "awk bash cat chmod cksum cp dirname grep head id mkdir mktemp rm tail uname".split()
GUESTS = ("board", "controls", "factored", "motion", "peers", "programs", "regression", "serving")
LOCK = "--no-deps --require-hashes -r .ci/requirements.lock"
# An interpreter that pretends: it makes an environment of itself and notes the packages to install.
PRETENDER = r"""
case "$*" in
    "-c "*) answer ;;
    "-m venv --clear "*)
        rm -rf "$4" && mkdir -p "$4/bin" && cp "$0" "$4/bin/python"
        echo "made by $name" >>log
        venv ;;
    "-m pip install "*) echo "$name: ${*:3}" >>log; install "$@" ;;
    "-m pip --version" | "-m pip check" | "-P -") ;;
    "- "*) exec "$real" "$@" ;;
    *) exit 2 ;;
esac
"""
FAILS = "echo no network >&2; exit 1"


class Checkout:
    """A folder with the files that setup reads, and a PATH of interpreters that pretend."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        guests = [f"agents/guests/{guest}/pyproject.toml" for guest in GUESTS]
        for name in ("pyproject.toml", ".ci/setup.sh", ".ci/requirements.lock", *guests):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
        self.path = folder.parent / f"{folder.name}-bin"
        self.path.mkdir()
        for tool in TOOLS:
            (self.path / tool).symlink_to(shutil.which(tool) or pytest.fail(f"no {tool} here"))

    def python(self, name: str, version: str = "3.12.1", install: str = ":", venv: str = ":") -> None:
        """Put an interpreter on the PATH; it complains of a version that is no number."""
        answer = f"echo {version}" if version[0].isdigit() else f"echo '{version}' >&2; exit 127"
        parts = {"answer": answer, "install": install, "venv": venv}
        functions = [f"{part}() {{ {does}; }}" for part, does in parts.items()]
        head = [f"#!{shutil.which('bash')}", f"name={name}", f"real={sys.executable}", *functions]
        (self.path / name).write_text("\n".join(head) + PRETENDER)
        (self.path / name).chmod(0o755)

    def setup(self, **variables: str) -> tuple[int, str]:
        """Exit code, and standard output and error together."""
        done = subprocess.run(
            [str(self.folder / ".ci/setup.sh")],
            env={"PATH": str(self.path)} | variables,
            stdout=PIPE,
            stderr=STDOUT,
            text=True,
            timeout=60,
            check=False,
        )
        return done.returncode, done.stdout

    def log(self) -> list[str]:
        """The calls of interpreters to make and install."""
        return (self.folder / "log").read_text().splitlines() if (self.folder / "log").exists() else []


@pytest.fixture
def checkout(tmp_path: Path) -> Checkout:
    return Checkout(tmp_path / "a checkout")


@pytest.fixture
def ready(checkout: Checkout) -> Checkout:
    """One that is set up."""
    checkout.python("python3")
    assert checkout.setup()[0] == 0
    return checkout


def test_interpreters_that_fail_are_named_and_passed_over(checkout: Checkout) -> None:
    """One that has two names is tried once."""
    for name in ("python3", "python3.13"):
        checkout.python(name, "3.13.0", install=FAILS)
    checkout.python("python3.12", "3.12.1", venv="echo No module named ensurepip; exit 1")
    checkout.python("python3.11", "3.11.2")
    code, out = checkout.setup()
    assert code == 0 and out.endswith("setup: ready\n"), out
    assert "setup: not python3.12 (3.12.1): cannot make a virtual environment: No module named ensurepip (Debian" in out
    made = [line for line in checkout.log() if "made" in line]
    assert made == ["made by python3", "made by python3.12", "made by python3.11"]


def test_without_a_usable_interpreter_each_is_named(checkout: Checkout) -> None:
    checkout.python("python3", "3.9.18")
    checkout.python("python3.14", "pyenv: python3.14: command not found")
    checkout.python("python3.13", "3.13.0", install=FAILS)
    code, out = checkout.setup()
    assert code == 1
    assert out.partition("no Python could be used. Tried:\n")[2].splitlines() == [
        "  python3: is Python 3.9.18, needed is one of 3.11 3.12 3.13 3.14",
        "  python3.14: does not run: pyenv: python3.14: command not found",
        "  python3.13 (3.13.0): the packages of .ci/requirements.lock could not be installed; see above",
        "  python3.12: not found",
        "  python3.11: not found",
        "  uv: not found",
        "Install one of Python 3.11 3.12 3.13 3.14 and run PYTHON=/its/path make setup.",
    ]


def test_an_interpreter_that_was_named_is_the_only_one(ready: Checkout) -> None:
    ready.python("python3.11", "3.11.7")
    code, out = ready.setup(PYTHON="python3.10")
    assert (code, out.splitlines()[-2:]) == (1, ["setup: PYTHON=python3.10 cannot be used:", "  python3.10: not found"])
    assert (ready.folder / ".venv/bin/python").exists(), "earlier files are left"
    assert ready.setup(PYTHON="python3") == (0, ""), "the same version"
    code, out = ready.setup(PYTHON=str(ready.path / "python3.11"))  # a path with a space
    assert code == 0 and "making .venv anew: PYTHON asks for another Python than its 3.12.1" in out
    assert ready.log()[-1].startswith("python3.11: ")


def test_packages_come_from_the_lock_with_hashes(ready: Checkout) -> None:
    installs = [line.partition("--retries 1 ")[2] for line in ready.log() if " install " in line]
    guests = "".join(f" -e agents/guests/{guest}/" for guest in GUESTS)
    assert installs[1] == LOCK and installs[-1] == f"--no-deps --no-build-isolation -e .{guests}"
    plain = {line for line in installs if "--no-deps" not in line}
    assert plain == set() or (sys.platform != "linux" and len(plain) == 1), "only torch outside Linux brings others"
    assert ready.setup() == (0, ""), "again, nothing is left to do"


def test_the_plain_torch_comes_last_and_with_its_libraries(checkout: Checkout) -> None:
    checkout.python("python3", install='[[ "$*" != *+cpu* ]]')
    code, out = checkout.setup(TORCH_INDEX="file:///nowhere")
    torch = [line.partition("--retries 1 ")[2] for line in checkout.log() if "torch==" in line]
    assert code == 0, out
    if sys.platform == "linux":
        assert len(torch) == 4 and "--extra-index-url file:///nowhere" in torch[1] and "(several GB)" in out
    assert torch[-1].startswith("torch==") and "+cpu" not in torch[-1]


def test_a_moved_checkout_is_repaired(ready: Checkout) -> None:
    script, binary = ready.folder / ".venv/bin/tool", ready.folder / ".venv/bin/binary"
    script.write_text(f"#!{ready.folder}/.venv/bin/python\n")
    script.chmod(0o755)
    binary.write_bytes(b"\0" + bytes(ready.folder))
    installed = len(ready.log())
    moved = ready.folder.rename(ready.folder.parent / "elsewhere")
    ready.folder = moved
    code, out = ready.setup()
    assert code == 0 and "setup: .venv was moved; repairing it\n" in out
    assert (moved / ".venv/bin/tool").read_text() == f"#!{moved}/.venv/bin/python\n"
    assert os.access(moved / ".venv/bin/tool", os.X_OK)
    assert (moved / ".venv/bin/binary").read_bytes() == b"\0" + bytes(script.parents[2])
    assert "-e ." in ready.log()[-1] and len(ready.log()) > installed, "the checkout is installed where it is now"
    assert ready.setup() == (0, "")


def test_an_interrupted_setup_starts_anew(checkout: Checkout) -> None:
    checkout.python("python3", install="kill -TERM $PPID; exit 1")
    code, out = checkout.setup()
    assert code == 130 and "ready" not in out and "not python3" not in out, "no other interpreter is tried"
    checkout.python("python3")
    code, out = checkout.setup()
    assert code == 0 and "making .venv anew: an installation in it did not finish" in out


def test_an_update_that_fails_leaves_the_environment(ready: Checkout) -> None:
    with (ready.folder / "pyproject.toml").open("a") as file:
        file.write("# changed\n")
    works, ready.path = ready.path, ready.folder / ".venv/bin"
    ready.python("python", install=FAILS)
    ready.path = works
    code, out = ready.setup()
    assert code == 1 and "could not be installed; see above." in out.splitlines()[-1]
    ready.path = ready.folder / ".venv/bin"
    ready.python("python")
    ready.path = works
    assert ready.setup() == (0, "setup: bringing .venv up to date\nsetup: ready\n")


def test_an_environment_without_its_python_is_made_anew(ready: Checkout) -> None:
    (ready.folder / ".venv/bin/python").unlink()
    (ready.folder / ".venv/bin/python").symlink_to("/nowhere/python3")
    code, out = ready.setup()
    assert code == 0 and "making .venv anew: its Python not found" in out


def test_an_activated_environment_is_not_made_with_itself(ready: Checkout) -> None:
    (ready.folder / ".venv/bin/python").rename(ready.folder / ".venv/bin/python3")
    code, out = ready.setup(PATH=f"{ready.folder}/.venv/bin:{ready.path}")
    assert code == 0, out
    assert not (ready.folder / ".venv/bin/python3").exists() and (ready.folder / ".venv/bin/python").exists()


def make(*words: str, **variables: str) -> tuple[int, str]:
    """Exit code and last line of make, which only prints its commands; its own variables would reach the inner make."""
    kept = {name: os.environ[name] for name in ("PATH", "HOME", "TMPDIR", "LANG", "LC_ALL") if name in os.environ}
    command = ["make", "-n", *words]
    done = subprocess.run(command, cwd=ROOT, env=kept | variables, stdout=PIPE, stderr=STDOUT, text=True, check=False)
    return done.returncode, done.stdout.splitlines()[-1].rstrip()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("bench", "bench --task {}"),
        ("bench TASK=pick_place PRESET=smoke ARGS=--out+x", "bench --task pick_place --preset smoke --out x"),
        (
            "peers SEEDS=7 BUDGETS=9",
            "bench --task {} --agents sb3_dqn sb3_qrdqn sb3_dqn_latents dreamer_v3 dreamer_v3_latents lewm "
            "--seeds 7 --budgets 9",
        ),
        ("test ARGS=-k+setup", "-m pytest -n auto --dist worksteal -k setup"),
    ],
)  # fmt: skip
def test_variables_become_options(words: str, expected: str) -> None:
    code, command = make(*(word.replace("+", " ") for word in words.split()))
    did = command.partition("imagine-bench ")[2] or command.partition("python ")[2]
    assert (code, did) == (0, expected.format("arrow_puzzle"))


def test_variables_count_and_unknown_ones_are_refused() -> None:
    assert make("report", TASK="pick_place")[1].endswith("report --task pick_place")
    code, error = make("bench", "AGENT=dqn", "SEEDS=0")
    assert code == 2 and "'make bench' takes no AGENT. It takes AGENTS APPEARANCE ARGS BUDGETS " in error
    code, error = make("doctor", "TASK=arrow_puzzle")
    assert code == 2 and "'make doctor' takes no TASK." in error
